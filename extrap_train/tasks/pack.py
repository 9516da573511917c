"""`task=pack`: a trained model made small enough for the package."""

from dataclasses import replace
from pathlib import Path

import torch

from extrap_train.config import TrainConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import load_model, save_compact
from extrap_train.diffusion.packaged import packaged_name, packaged_weights
from extrap_train.runs import existing_run
from extrap_train.store import Outcome
from extrap_train.store.digests import weights_digest
from extrap_train.store.manifest import Manifest, claim
from extrap_train.tasks.scene_model import UsedWeights, model_of, model_options
from extrap_train.terminal import terminal

_BASE = "base"
_REMEDY = "give another output= or resume=false to replace it"


def run(config: TrainConfig) -> Outcome:
    """Write the newest (or `weights`) model under the name that the package gives it."""
    console = terminal()
    weights = config.weights or str(existing_run(config).model)
    config = replace(config, weights=weights)
    model = model_of(config, weights)
    name = packaged_name(model.config.family, config.category.name)
    folder = Path(config.output) / "packed" / name
    base = weights_digest(packaged_weights(_BASE))
    inputs = {**UsedWeights.of(config).inputs(), f"weights of {_BASE}": base}
    manifest = Manifest.of(model_options(config), inputs)
    with claim(folder, manifest, resume=config.resume, remedy=_REMEDY) as result:
        if not result.is_reused:
            with result.replace() as made:
                save_compact(model, made, _BASE)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    lost = _lost_share(model, load_model(folder), load_model(packaged_weights(_BASE)))
    console.print(
        f"{size / 1e6:.1f} MB; of the training's movement away from {_BASE}, {lost:.1%} is lost"
    )
    console.print(f"result: {folder}")
    return Outcome(folder, result.is_reused)


def _lost_share(
    model: ExtrapolationModel, restored: ExtrapolationModel, base: ExtrapolationModel
) -> float:
    """Squared error over squared movement, over all weights that both models have."""
    wanted, start = model.state_dict(), base.state_dict()
    shared = [name for name, x in wanted.items() if name in start and start[name].shape == x.shape]
    again = restored.state_dict()
    lost = sum(float((again[name] - wanted[name]).square().sum()) for name in shared)
    moved = sum(float((wanted[name] - start[name]).square().sum()) for name in shared)
    return lost / max(moved, torch.finfo().tiny)
