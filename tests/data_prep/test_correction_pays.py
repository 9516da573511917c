"""Training on corrected warps against training on uncorrected ones, with errors put into the depth.

`python -m pytest -s -m slow tests/data_prep/test_correction_pays.py` prints the table.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import hydra
import lightning
import numpy as np
import pandas as pd
import pytest
import torch
from torch.nn import functional

from data_prep.preparation import prepare
from data_prep.synthesize import synthesize
from extrap_train.cli import register_schemas, typed_config
from extrap_train.config import FlowMatcherConfig, SyntheticConfig, TrainConfig
from extrap_train.data.co3d import read_category
from extrap_train.data.examples import ExampleReader
from extrap_train.data.module import PairModule
from extrap_train.data.prepared import PreparedData
from extrap_train.depth import DatasetDepth, DepthMap
from extrap_train.diffusion.averaging import AveragedWeights
from extrap_train.diffusion.model_files import initial_model
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.jobs.local import LocalLauncher
from extrap_train.matching import Matcher
from extrap_train.matching.matchers import matcher
from extrap_train.views import View

DATA = SyntheticConfig(train_sequences=10, test_sequences=3)
SEEDS, STEPS, VIEWS = (0, 1, 2), 150, 60
AMOUNT, NOISE = 0.05, 0.001


@dataclass(frozen=True)
class WrongDepth(DatasetDepth):
    """Exact depth times factors of low frequency, up to 1 ± `AMOUNT`, plus noise; of each view its
    own."""

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        return [
            DepthMap(found.depth * factors(index, found.depth.shape), found.confidence)
            for index, found in enumerate(super().depth_maps(views))
        ]


def factors(seed: int, shape: torch.Size) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.randn(1, 1, 4, 4, generator=generator)
    field = functional.interpolate(coarse, tuple(shape), mode="bicubic", align_corners=True)[0, 0]
    noise = NOISE * torch.randn(shape, generator=generator)
    return 1 + AMOUNT * field / field.abs().max() + noise


@dataclass(frozen=True)
class Captures:
    """The same hydrants three times."""

    uncorrected: PreparedData
    corrected: PreparedData
    exact: PreparedData


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Captures:
    root = tmp_path_factory.mktemp("hydrants")
    synthesize(DATA, "hydrant", root / "captures", LocalLauncher(1))
    sequences = read_category(root / "captures", "hydrant")
    tested = {f"{index:04d}" for index in range(DATA.test_sequences)}

    def prepared(name: str, depth: DatasetDepth, how: Matcher | None = None) -> PreparedData:
        return prepare(
            sequences,
            depth,
            configuration(0).prep,
            test_names=tested,
            folder=root / name,
            matcher=how,
            progress=False,
        )

    return Captures(
        prepared("uncorrected", WrongDepth()),
        prepared("corrected", WrongDepth(), matcher(FlowMatcherConfig())),
        prepared("exact", DatasetDepth()),
    )


def configuration(seed: int) -> TrainConfig:
    """Continues the packaged base for a few steps, so its moving average must forget soon."""
    options = ["category=hydrant", f"seed={seed}", f"trainer.steps={STEPS}"]
    options += ["trainer.warmup_steps=20", "trainer.ema_decay=0.97", "trainer.workers=0"]
    options += [f"trainer.checkpoint_every={STEPS}", f"validation.examples={VIEWS}"]
    register_schemas()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        return typed_config(hydra.compose("train", options))


def batches(config: TrainConfig, train: PreparedData, test: PreparedData) -> PairModule:
    readers = [
        ExampleReader([data], split, config.model.references)
        for data, split in ((train, "train"), (test, "test"))
    ]
    return PairModule(*readers, config)


def trained_and_tested(
    seed: int, train: PreparedData, tests: dict[str, PreparedData]
) -> dict[str, pd.Series]:
    """Mean scores of the model on the held-out views of each of `tests`."""
    config = configuration(seed)
    torch.manual_seed(seed)
    modules = {name: batches(config, train, data) for name, data in tests.items()}
    batch_sizes = [len(batch) for batch in next(iter(modules.values())).held_out.batches]
    names = [[f"{batch}-{i}" for i in range(size)] for batch, size in enumerate(batch_sizes)]
    training = CategoryTraining(initial_model(config.model), config, names, None)
    trainer = lightning.Trainer(
        accelerator="cpu",
        precision="bf16-mixed",
        max_steps=STEPS,
        num_sanity_val_steps=0,
        check_val_every_n_epoch=2,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[AveragedWeights(config.trainer.ema_decay)],
    )
    trainer.fit(training, next(iter(modules.values())))
    found = {}
    for name, module in modules.items():
        trainer.validate(training, module, verbose=False)
        scores = training.scores()
        found[name] = scores[scores["method"] == "model"].mean(numeric_only=True)
    return found


@pytest.mark.slow
def test_training_on_corrected_warps_is_better(captures: Captures) -> None:
    moved = (captures.corrected.pairs("train").flow >= 0).mean()
    print(f"\n{moved:.0%} of {len(captures.corrected.pairs('train'))} training warps are corrected")
    tests = {"exact depth": captures.exact, "wrong depth": captures.uncorrected}
    rows = []
    for seed in SEEDS:
        for arm in ("uncorrected", "corrected"):
            scores = trained_and_tested(seed, getattr(captures, arm), tests)
            rows += [
                {"seed": seed, "trained on": arm, "tested on": k, **v} for k, v in scores.items()
            ]
            print(pd.DataFrame(rows[-2:]).round(3).to_string(index=False), flush=True)
    table = pd.DataFrame(rows).pivot_table(
        index=["tested on", "seed"], columns="trained on", values="psnr"
    )
    gain = (table["corrected"] - table["uncorrected"]).groupby("tested on").agg(["mean", "std"])
    print(table.round(3), gain.round(3), sep="\n")
    assert gain.loc["exact depth", "mean"] > 0
    assert np.isfinite(table.to_numpy()).all()
