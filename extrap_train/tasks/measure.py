"""A trained model measured on the held-out views, as its training was."""

import time
from dataclasses import replace
from typing import Any, cast

import lightning
from rich.console import Console

from extrap_train.config import TrainConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.metrics import lpips_or_reason
from extrap_train.runs import RunFolder, provenance
from extrap_train.tasks.category import quieten_lightning
from extrap_train.tasks.results import Results, write_results
from extrap_train.tasks.training_data import data_module, prepared_data, validation_names


def measure(model: ExtrapolationModel, steps: int, config: TrainConfig, folder: RunFolder) -> None:
    """Write metrics, pictures and `summary.json` of a model that was trained for `steps`.

    Views are sampled as the model recommends, but for what `config.sampler` says, and in the
    model's own groups.
    """
    quieten_lightning()
    distance, missing = lpips_or_reason(config.validation.lpips_weights)
    started = time.perf_counter()
    prepared = prepared_data(config)
    seconds = {"prepare": time.perf_counter() - started}
    data = data_module(replace(config, model=model.config), prepared)
    validation = CategoryTraining(model, config, validation_names(data), distance)
    _validator(config).validate(validation, data, verbose=False)
    seconds["validate"] = validation.validation_seconds
    results = Results(
        scores=validation.scores(),
        shown=validation.pictures(),
        missing=missing,
        seconds=seconds,
        steps=steps,
        parameters=sum(p.numel() for p in model.parameters()),
        provenance=provenance(config, {d.folder.name: d.manifest["key"] for d in prepared}),
    )
    write_results(results, config, folder, Console())


def _validator(config: TrainConfig) -> lightning.Trainer:
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
