"""A trained model measured on the held-out views, as its training was."""

import time
from dataclasses import dataclass, replace
from typing import Any, cast

import lightning

from extrap_train.config import TrainConfig
from extrap_train.data.prepared import PreparedData
from extrap_train.device import require_accelerator
from extrap_train.diffusion.checkpoint import saved_config
from extrap_train.diffusion.model import ExtrapolationModel, use_channels_last
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.metrics import lpips_or_reason
from extrap_train.runs import RunFolder, provenance, trained_on
from extrap_train.store.cache import Conflict, read_manifest
from extrap_train.tasks.category import quieten_lightning
from extrap_train.tasks.leakage import require_unseen
from extrap_train.tasks.results import Results, write_results
from extrap_train.tasks.saved_model import require_as_said
from extrap_train.tasks.training_data import Prepare, data_module, validation_names
from extrap_train.terminal import terminal


@dataclass(frozen=True)
class RunData:
    """The data of a finished run, whose held-out views its model has never seen."""

    prepared: list[PreparedData]
    seconds: float
    """To prepare them."""

    @classmethod
    def of(cls, trained: RunFolder, config: TrainConfig, prepare: Prepare) -> "RunData":
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
        require_as_said(saved, config.model, trained.model)
        require_unseen(saved.start, today)
        return cls(prepared, time.perf_counter() - started)


def measure(
    model: ExtrapolationModel, steps: int, config: TrainConfig, data: RunData, folder: RunFolder
) -> None:
    """Write metrics, pictures and `summary.json` of a model that was trained for `steps`.

    Views are sampled as the model recommends, but for what `config.sampler` says, and in the
    model's own groups.
    """
    quieten_lightning()
    distance, missing = lpips_or_reason(config.validation.lpips_weights)
    pairs = data_module(replace(config, model=model.config), data.prepared)
    validation = CategoryTraining(
        use_channels_last(model), config, validation_names(pairs), distance
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
        precision=cast(Any, config.trainer.precision),
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        deterministic="warn",
    )
