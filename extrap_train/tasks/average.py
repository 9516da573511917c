"""`task=average`: a trained model with averaged weights of another length, and how good it is."""

import time
from pathlib import Path
from typing import Any, cast

import lightning
from rich.console import Console

from extrap_train.config import TrainConfig
from extrap_train.diffusion.averages import take_average
from extrap_train.diffusion.checkpoint import load_model, save_model
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.metrics import lpips_or_reason
from extrap_train.runs import RunFolder, existing_run, provenance
from extrap_train.tasks.category import quieten_lightning
from extrap_train.tasks.results import Results, write_results
from extrap_train.tasks.training_data import data_module, prepared_data, validation_names


def run(config: TrainConfig) -> Path:
    """Make the model of `average_width` from the run's snapshots and validate it as the run was."""
    console = Console()
    quieten_lightning()
    distance, missing = lpips_or_reason(config.validation.lpips_weights)
    trained = existing_run(config)
    model = load_model(trained.model)
    step = take_average(model, trained.averages, config.average_width)
    started = time.perf_counter()
    prepared = prepared_data(config)
    seconds = {"prepare": time.perf_counter() - started}
    data = data_module(config, prepared)
    validation = CategoryTraining(model, config, validation_names(data), distance)
    _validator(config).validate(validation, data, verbose=False)
    seconds["validate"] = validation.validation_seconds
    folder = RunFolder(trained.averages / f"width-{config.average_width:g}")
    save_model(model, folder.model)
    results = Results(
        scores=validation.scores(),
        shown=validation.pictures(),
        missing=missing,
        seconds=seconds,
        steps=step,
        parameters=sum(p.numel() for p in model.parameters()),
        provenance=provenance(config, {d.folder.name: d.manifest["key"] for d in prepared}),
    )
    write_results(results, config, folder, console)
    return folder.path


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
