"""`task=category`, the main job: data, training, validation, and the files that a run leaves."""

import json
import logging
import math
import os
import shutil
import time
import warnings
from pathlib import Path
from typing import Any, cast

import lightning
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from rich.console import Console
from rich.table import Table

from extrap_train.config import TrainConfig
from extrap_train.data.examples import ExampleReader
from extrap_train.data.files import write_whole
from extrap_train.data.module import PairModule
from extrap_train.diffusion.callbacks import (
    AveragedWeights,
    EpochCheckpoints,
    MetricsTable,
    StepProgress,
    WholeCheckpointIO,
    checkpoints,
)
from extrap_train.diffusion.checkpoint import save_model, start_weights
from extrap_train.diffusion.evaluation import Distance, Prediction, summarise
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.errors import InputError
from extrap_train.metrics import squeeze_lpips
from extrap_train.pictures import contact_sheet, error_map, mark_holes
from extrap_train.runs import RunFolder, open_run, provenance
from extrap_train.tasks.prepare import prepare_category


def run(config: TrainConfig) -> None:
    """Train a category model and leave weights, metrics, pictures and `summary.json` behind."""
    console = Console()
    _quieten_lightning()
    distance, missing = _lpips(config)
    model = _model(config)
    folder = open_run(config)
    if config.resume and _finished(folder, config.trainer.steps):
        console.print(f"already trained for {config.trainer.steps} steps: {folder.path}")
        return
    if not config.resume:
        shutil.rmtree(folder.checkpoints, ignore_errors=True)
        (folder.path / "metrics.csv").unlink(missing_ok=True)
    started = time.perf_counter()
    prepared = [
        prepare_category(
            member,
            config.data,
            config.depth,
            config.prep,
            output=Path(config.output),
            workers=os.cpu_count() or 1,
        )
        for member in config.category.members
    ]
    seconds = {"prepare": time.perf_counter() - started}
    readers = {
        split: ExampleReader(prepared, split, config.model.references)
        for split in ("train", "test")
    }
    data = _data_module(config, readers["train"], readers["test"])
    training = CategoryTraining(model, config, _names(data), distance)
    started = time.perf_counter()
    trainer = _trainer(config, folder, training)
    trainer.fit(training, data, ckpt_path=_newest(folder), weights_only=True)
    seconds["train"] = time.perf_counter() - started
    if training.validated_step != trainer.global_step:
        trainer.validate(training, data, verbose=False)
    seconds["validate"] = training.validation_seconds
    save_model(training.model, folder.model)
    training.scores().to_csv(folder.path / "validation.csv", index=False)
    draw(training.pictures(), folder.samples / "final.png")
    validation = summarise(training.scores())
    summary = {
        "validation": validation,
        "missing": missing,
        "seconds": seconds,
        "steps": trainer.global_step,
        "parameters": sum(p.numel() for p in training.model.parameters()),
        "provenance": provenance(config, {d.folder.name: d.manifest["key"] for d in prepared}),
    }
    write_whole(folder.summary, (json.dumps(_without_nan(summary), indent=1) + "\n").encode())
    console.print(_table(validation))
    for name, reason in missing.items():
        console.print(f"missing {name}: {reason}")
    console.print(f"pictures: {folder.samples / 'final.png'}\nresult: {folder.path}")


def _quieten_lightning() -> None:
    """Its tips and device lists say nothing about the user's run."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    warnings.filterwarnings("ignore", message=".*(weights|pretrained).*", module="torchvision")


def _finished(folder: RunFolder, steps: int) -> bool:
    if not folder.summary.is_file():
        return False
    return int(json.loads(folder.summary.read_text())["steps"]) >= steps


def _lpips(config: TrainConfig) -> tuple[Distance | None, dict[str, str]]:
    try:
        return squeeze_lpips(config.validation.lpips_weights), {}
    except InputError as error:
        if config.validation.lpips_weights is not None:
            raise
        return None, {"lpips": str(error)}


def _model(config: TrainConfig) -> ExtrapolationModel:
    torch.manual_seed(config.seed)
    model = ExtrapolationModel(config.model)
    start_weights(model, config.model.start)
    return model.to(memory_format=torch.channels_last)


def _data_module(
    config: TrainConfig, train: ExampleReader, validation: ExampleReader
) -> PairModule:
    for split, reader in (("training", train), ("test", validation)):
        if not len(reader):
            raise InputError(
                f"no {split} pairs for {config.category.name}: see the preparation's report, "
                "and loosen the options under prep"
            )
    return PairModule(
        train,
        validation,
        batch_size=config.trainer.batch_size,
        batches_per_epoch=min(config.trainer.checkpoint_every, config.trainer.steps),
        validation_examples=config.validation.examples,
        validation_batch_size=config.validation.batch_size,
        references=config.model.references,
        workers=config.trainer.workers,
        seed=config.seed,
    )


def _names(data: PairModule) -> list[list[str]]:
    names = [data.validation.name(index) for index in data.chosen]
    size = data.validation_batch_size
    return [names[i : i + size] for i in range(0, len(names), size)]


def _newest(folder: RunFolder) -> str | None:
    saved = checkpoints(folder.checkpoints)
    return str(saved[-1]) if saved else None


class _Pictures(lightning.Callback):
    """A sheet after every validation of a run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_validation_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        assert isinstance(pl_module, CategoryTraining)
        if trainer.is_global_zero and not trainer.sanity_checking:
            draw(pl_module.pictures(), self.folder / f"step-{trainer.global_step:08d}.png")


def _trainer(
    config: TrainConfig, folder: RunFolder, training: CategoryTraining
) -> lightning.Trainer:
    options = config.trainer
    newest = _newest(folder)
    resumed_step = int(Path(newest).stem.split("-")[1]) if newest else 0
    epoch = min(options.checkpoint_every, options.steps)
    return lightning.Trainer(
        accelerator=options.accelerator,
        devices=options.devices,
        precision=cast(Any, options.precision),
        max_steps=options.steps,
        max_epochs=-1,
        check_val_every_n_epoch=max(1, options.validate_every // epoch),
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        log_every_n_steps=20,
        deterministic="warn",
        logger=[
            MetricsTable(folder.path / "metrics.csv", resumed_step),
            TensorBoardLogger(folder.path, name="", version="tensorboard"),
        ],
        plugins=[WholeCheckpointIO()],
        callbacks=[
            AveragedWeights(options.ema_decay),
            StepProgress(options.steps),
            _Pictures(folder.samples),
            EpochCheckpoints(folder.checkpoints),
        ],
    )


def draw(prediction: Prediction, path: Path) -> None:
    """Reference, warp, output, truth and error, a row per view."""
    batch, images = prediction.batch, prediction.images
    assert batch.warp is not None
    contact_sheet(
        {
            "nearest photo": images["nearest"],
            "warp": mark_holes(batch.warp.image, batch.warp.mask),
            "inpainted": images["inpainted"],
            "model": images["model"],
            "truth": batch.image,
            "error": error_map(images["model"], batch.image),
        },
        path,
    )


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: a mean over no view at all becomes null."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


def _table(validation: dict[str, dict[str, float]]) -> Table:
    metrics = list(next(iter(validation.values())))
    table = Table("", *metrics, title="held-out views")
    for method, row in validation.items():
        table.add_row(method, *(f"{row[metric]:.3f}" for metric in metrics))
    return table
