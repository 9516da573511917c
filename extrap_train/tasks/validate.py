"""`task=validate`: a finished run measured again, sampled as the options under `sampler` say."""

import hashlib
import json
import time
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import lightning

from extrap_train.config import TrainConfig, dotted, sampler_for
from extrap_train.data.prepared import PreparedData
from extrap_train.device import require_accelerator, trainer_precision
from extrap_train.diffusion.checkpoint import load_model, saved_config
from extrap_train.diffusion.model import ExtrapolationModel, use_channels_last
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.metrics import lpips_or_reason
from extrap_train.runs import Finished, RunFolder, existing_run, provenance, trained_on
from extrap_train.store import Outcome
from extrap_train.store.digests import folder_digest
from extrap_train.store.manifest import MANIFEST, Conflict, Manifest, claim, read_manifest
from extrap_train.store.records import write_record
from extrap_train.tasks.category import quieten_lightning
from extrap_train.tasks.results import Results, write_results
from extrap_train.tasks.scene_model import require_saved_options
from extrap_train.tasks.training_data import Prepare, data_module, require_unseen
from extrap_train.terminal import terminal


@dataclass(frozen=True)
class _RunData:
    """The data of a finished run, whose held-out views its model has never seen."""

    prepared: list[PreparedData]
    seconds: float
    """To prepare them."""

    @classmethod
    def of(cls, trained: RunFolder, config: TrainConfig, prepare: Prepare) -> "_RunData":
        """InputError where the options and what lies there today are not what it was trained on."""
        started = time.perf_counter()
        prepared = prepare(config)
        before = read_manifest(trained.path, "train another run=NAME")
        inputs, split = trained_on(config, prepared)
        today = replace(before, inputs={**before.inputs, **inputs}, split=split)
        if differences := today.differences(before):
            raise Conflict(
                f"{trained.path}: trained on different {', '.join(differences)}; restore the data "
                "and their options, or measure another run=NAME"
            )
        saved = saved_config(trained.model)
        require_saved_options(saved, config.model, trained.model)
        require_unseen(saved.start, today)
        return cls(prepared, time.perf_counter() - started)


def run(config: TrainConfig, prepare: Prepare) -> Outcome:
    """Sample the held-out views with the run's model; leaves the scores in the run's folder."""
    trained = existing_run(config)
    data = _RunData.of(trained, config, prepare)
    steps = Finished.read(trained).steps
    model = load_model(trained.model)
    sampler = sampler_for(config.sampler, model.config)
    options = {"sampler": asdict(sampler), "validation": asdict(config.validation)}
    digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode()).hexdigest()[:8]
    folder = RunFolder(trained.path / "validations" / f"seed{config.seed}-{digest}")
    manifest = Manifest.of(dotted(options), {"model": folder_digest(trained.model)})
    with claim(folder.path, manifest, resume=False):
        _measure(model, steps, config, data, folder)
        write_record(folder.path / MANIFEST, manifest)
    return Outcome(folder.path)


def _measure(
    model: ExtrapolationModel, steps: int, config: TrainConfig, data: _RunData, folder: RunFolder
) -> None:
    """Write metrics, pictures and `summary.json` of a model that was trained for `steps`.

    Views are sampled as the model recommends, but for what `config.sampler` says, and in the
    model's own groups.
    """
    quieten_lightning()
    distance, missing = lpips_or_reason(config.validation.lpips_weights)
    pairs = data_module(replace(config, model=model.config), data.prepared)
    validation = CategoryTraining(
        use_channels_last(model), config, pairs.validation_names(), distance
    )
    _validator(config).validate(validation, pairs, verbose=False)
    results = Results(
        scores=validation.scores(),
        shown=validation.pictures(),
        missing=missing,
        seconds={"prepare": data.seconds, "validate": validation.validation_seconds},
        steps=steps,
        parameters=sum(p.numel() for p in model.parameters()),
        provenance=provenance(config, {d.folder.name: d.manifest["key"] for d in data.prepared}),
    )
    write_results(results, config, folder, terminal())


def _validator(config: TrainConfig) -> lightning.Trainer:
    require_accelerator(config.trainer.accelerator)
    return lightning.Trainer(
        accelerator=config.trainer.accelerator,
        devices=1,
        precision=cast(Any, trainer_precision(config.trainer)),
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        deterministic="warn",
    )
