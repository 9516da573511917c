"""`task=category`, the main job: data, training and validation of a category model."""

import logging
import signal
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import lightning
import torch
from lightning.pytorch.loggers import Logger
from rich.console import Console

from extrap_train.config import TrainConfig, TrainerConfig, resolve_paths
from extrap_train.data.module import PairModule
from extrap_train.device import (
    advise_on_training_memory,
    require_accelerator,
    trainer_device,
    trainer_precision,
)
from extrap_train.diffusion.averaging import AveragedWeights
from extrap_train.diffusion.callbacks import MetricsTable, StepProgress
from extrap_train.diffusion.checkpoints import (
    Checkpoints,
    WholeCheckpointIO,
    newest_intact,
    restoring,
    step_of,
    thin_checkpoints,
)
from extrap_train.diffusion.footprint import Footprint, require_room
from extrap_train.diffusion.hub import pin_revision
from extrap_train.diffusion.model import ExtrapolationModel, use_channels_last
from extrap_train.diffusion.model_files import initial_model, save_model
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.metrics import lpips_or_reason
from extrap_train.processes import Opening, announce, is_first, join, meet
from extrap_train.runs import (
    Finished,
    RunFolder,
    in_sweep,
    point_latest,
    require_same_options,
    run_folder,
    run_manifest,
    write_options,
)
from extrap_train.store import Outcome
from extrap_train.store.manifest import REMEDY, Conflict, Manifest, claim
from extrap_train.tasks.loggers import log_sheet, open_logger, require_logger
from extrap_train.tasks.results import (
    draw_curve,
    draw_views,
    keep_start_scores,
    print_places,
    write_results,
)
from extrap_train.tasks.training_data import Prepare, cached_encoder, data_module, require_unseen
from extrap_train.terminal import terminal


def run(config: TrainConfig, prepare: Prepare) -> Outcome:
    """Train a category model and leave weights, metrics, pictures and `summary.json` behind.

    Nothing of a run is begun or removed before its options, its start and its data are known to be
    good.
    """
    require_accelerator(config.trainer.accelerator)
    require_logger(config.logger.name)
    console = terminal(quiet=not is_first())
    quieten_lightning()
    distance, missing = lpips_or_reason(config.validation.lpips_weights)
    folder = run_folder(config)
    require_same_options(folder, config)  # before what takes minutes
    model = _model(config)
    started = time.perf_counter()
    prepared = prepare(config)
    data = data_module(config, prepared, cached_encoder(config, model, prepared, console.print))
    seconds = {"prepare": time.perf_counter() - started}
    manifest = run_manifest(config, prepared)
    require_unseen(config.model.start, manifest)
    footprint = Footprint.of(model, config.trainer)
    with _open_run(folder, config, manifest, footprint, console) as opening:
        if opening.is_finished:
            steps = Finished.read(folder).steps
            console.print(f"already trained for {steps} steps: {folder.path}")
        else:
            training = CategoryTraining(model, config, data.validation_names(), distance)
            with open_logger(config, folder) as loggers:
                _train(training, data, opening.checkpoint, folder, seconds, loggers)
            if is_first():
                save_model(training.model, folder.model)
                draw_curve(folder)
                steps = training.validated_step
                write_results(training, prepared, missing, seconds, steps, folder, console)
                print_places(folder, console)
        if is_first():  # a longer training goes on from the newest, but for a sweep's job
            thin_checkpoints(folder.checkpoints, keep=0 if in_sweep() else 1)
    return Outcome(folder.path, opening.is_finished)


@contextmanager
def _open_run(
    folder: RunFolder,
    config: TrainConfig,
    manifest: Manifest,
    footprint: Footprint,
    console: Console,
) -> Iterator[Opening]:
    """The run, closed to other commands; the first process opens it, the others follow.

    Only the first measures what is free: the GPU that is asked is its own, and of the others each
    would keep a context there.
    """
    meet()
    if not is_first():
        yield join(folder.path)
        return
    resume = config.resume and folder.has_learnt
    with claim(folder.path, manifest, resume=resume) as claimed:
        if not claimed.is_reused:
            claimed.begin()
        opening = _find_opening(folder, config, console)
        if not opening.is_finished:
            console.print(require_room(footprint, config.trainer, folder.path))
            write_options(folder, config, at_least=_resumed_step(opening.checkpoint))
        point_latest(folder)
        announce(folder.path, opening)
        yield opening


def _find_opening(folder: RunFolder, config: TrainConfig, console: Console) -> Opening:
    finished = Finished.read(folder) if folder.summary.is_file() else None
    if finished is not None and finished.answers(config):
        if finished.has_its_model(folder):
            return Opening(is_finished=True, checkpoint=None)
        console.print(f"{folder.model}: is missing, damaged or was changed, and is made again")
    newest = newest_intact(folder.checkpoints, console.print)
    if newest is None and finished is not None and finished.steps > config.trainer.steps:
        raise Conflict(
            f"{folder.path}: made with different trainer.steps (was {finished.steps}, now "
            f"{config.trainer.steps}); {REMEDY}"
        )
    if newest is not None:
        console.print(f"resuming at step {step_of(newest)}: {folder.path}")
    return Opening(is_finished=False, checkpoint=str(newest) if newest else None)


def _resumed_step(checkpoint: str | None) -> int:
    return step_of(Path(checkpoint)) if checkpoint else 0


def _train(
    training: CategoryTraining,
    data: PairModule,
    checkpoint: str | None,
    folder: RunFolder,
    seconds: dict[str, float],
    loggers: list[Logger],
) -> None:
    """Train and validate, and note how long both took.

    What the run starts from is measured before its first step.
    """
    started = time.perf_counter()
    every = data.batches_per_epoch
    kept = Checkpoints(folder.checkpoints, every)
    trainer = _trainer(training.config, folder, checkpoint, kept, loggers)
    with (
        _ended_together(trainer),
        kept.stoppable(),
        restoring(checkpoint, lambda: kept.has_begun),
        advise_on_training_memory(training.config.trainer),
    ):
        if checkpoint is None and training.config.model.start is not None:
            trainer.validate(training, data, verbose=False)
            if is_first():
                keep_start_scores(training.scores(), folder)
            started = time.perf_counter()
        trainer.fit(training, data, ckpt_path=checkpoint, weights_only=True)
        seconds["train"] = time.perf_counter() - started
        if training.validated_step != trainer.global_step:
            trainer.validate(training, data, verbose=False)
    seconds["validate"] = training.validation_seconds


def quieten_lightning() -> None:
    """Its tips and device lists say nothing about the user's run."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    warnings.filterwarnings("ignore", message=".*(weights|pretrained).*", module="torchvision")


def _model(config: TrainConfig) -> ExtrapolationModel:
    torch.manual_seed(config.seed)
    options = resolve_paths(config.model)
    if options.start is not None:  # the saved model says for good what it started from
        options = replace(options, start=pin_revision(options.start, "model.start"))
    model = use_channels_last(initial_model(options))
    if config.trainer.gradient_checkpointing:
        model.unet.enable_gradient_checkpointing()
    if config.trainer.compile:
        model.unet.compile()
    return model


@contextmanager
def _ended_together(trainer: lightning.Trainer) -> Iterator[None]:
    """An error ends the processes that Lightning has started, which would wait for this one."""
    try:
        yield
    except BaseException:
        if (launcher := trainer.strategy.launcher) is not None:
            cast(Any, launcher).kill(signal.SIGKILL)
        raise


class _Pictures(lightning.Callback):
    """A sheet after every validation of a run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_validation_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        assert isinstance(pl_module, CategoryTraining)
        if trainer.is_global_zero and not trainer.sanity_checking:
            file = self.folder / f"step-{trainer.global_step:08d}.png"
            draw_views(pl_module.pictures(), file)
            log_sheet(trainer.loggers, file, trainer.global_step)


def quiet_trainer(options: TrainerConfig, **more: Any) -> lightning.Trainer:
    """Lightning's trainer on the options' hardware, without its own checkpoints and bars.

    A CPU repeats itself to the bit; a GPU has slower algorithms for that, and only if asked.
    """
    repeats = options.deterministic or trainer_device(options).type == "cpu"
    # Filling what is empty repeats nothing and takes time.
    cast(Any, torch.utils.deterministic).fill_uninitialized_memory = False
    return lightning.Trainer(
        accelerator=options.accelerator,
        precision=cast(Any, trainer_precision(options)),
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        deterministic="warn" if repeats else False,
        **more,
    )


def _trainer(
    config: TrainConfig,
    folder: RunFolder,
    checkpoint: str | None,
    kept: Checkpoints,
    loggers: list[Logger],
) -> lightning.Trainer:
    options = config.trainer
    resumed_step = _resumed_step(checkpoint)
    return quiet_trainer(
        options,
        devices=options.devices,
        num_nodes=options.num_nodes,
        max_steps=options.steps,
        max_epochs=-1,
        check_val_every_n_epoch=max(1, options.validate_every // kept.every),
        reload_dataloaders_every_n_epochs=int(resumed_step % kept.every > 0),  # a short first epoch
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
        logger=[MetricsTable(folder.path / "metrics.csv", resumed_step), *loggers],
        plugins=[WholeCheckpointIO()],
        callbacks=[
            *([AveragedWeights(options.ema_decay)] if options.ema_decay else []),
            StepProgress(options.steps),
            _Pictures(folder.samples),
            kept,
        ],
    )
