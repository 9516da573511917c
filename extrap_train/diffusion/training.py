"""The training loop's mathematics and its optimiser, as a LightningModule."""

import time
from typing import Any

import lightning
import pandas as pd
import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor

from extrap_train.config import TrainConfig, TrainerConfig, sampler_for
from extrap_train.data.examples import linspace_indices
from extrap_train.data.module import shard
from extrap_train.diffusion.callbacks import ABOVE_BASELINES
from extrap_train.diffusion.evaluation import (
    Prediction,
    better_than_baselines,
    predict,
    score,
    summarise,
    views_named,
)
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.step_noise import noise_of_step
from extrap_train.errors import InputError
from extrap_train.metrics import Distance
from extrap_train.processes import gather_values
from extrap_train.views import PairBatch

_STEPS_A_ROW = 20
"""Steps per row of `metrics.csv` between two validations."""


class CategoryTraining(lightning.LightningModule):
    """Trains an ExtrapolationModel; validation samples held-out views and scores them."""

    def __init__(
        self,
        model: ExtrapolationModel,
        config: TrainConfig,
        validation_names: list[list[str]],
        lpips: Distance | None,
    ) -> None:
        super().__init__()
        self.model = model
        self.config = config
        self.sampler = sampler_for(config.sampler, model.config)
        self.validation_names = validation_names
        self.distance = lpips
        self.predictions: dict[int, Prediction] = {}
        self.tables: dict[int, pd.DataFrame] = {}
        self.validated_step = -1
        self.validation_seconds = 0.0

    def training_step(self, batch: PairBatch, batch_idx: int) -> Tensor:
        """One step; its noise is a function of the seed and the step."""
        options, world = self.config.trainer, self.trainer.world_size
        draws = noise_of_step(self.config.seed, self.global_step, self.global_rank, world)
        return diffusion_loss(self.model, batch, draws, options.condition_dropout, options.min_snr)

    def on_train_batch_end(self, outputs: Any, batch: PairBatch, batch_idx: int) -> None:
        """Record the loss now and then, the mean of all processes."""
        if self.global_step % _STEPS_A_ROW == 0:
            mean = self.trainer.strategy.reduce(outputs["loss"], reduce_op="mean")
            self._record({"loss": float(mean)})

    def validation_step(self, batch: PairBatch, batch_idx: int) -> None:
        """Sample the batch's queries."""
        of_all = len(self.validation_names)
        index = shard(of_all, self.global_rank, self.trainer.world_size)[batch_idx]
        names = self.validation_names[index]
        made = predict(self.model, batch, names, self.sampler, self.config.seed)
        if not made.images["model"].isfinite().all():
            raise InputError(
                f"step {self.global_step}: sampled views hold values that are not numbers: lower "
                "model.learning_rate, or sample with other options under sampler"
            )
        self.predictions[index] = made

    def on_validation_epoch_start(self) -> None:
        """Forget the last validation's pictures."""
        self.predictions = {}
        self._validation_started = time.perf_counter()

    def on_validation_epoch_end(self) -> None:
        """Bring all processes' views together, log the means, and remember the step."""
        self.validated_step = self.global_step
        self.validation_seconds = time.perf_counter() - self._validation_started
        own = {index: score(made, self.distance) for index, made in self.predictions.items()}
        self.tables = {
            index: table for tables in gather_values(own) for index, table in tables.items()
        }
        names = [name for batch in self.validation_names for name in batch]
        shown = [names[i] for i in linspace_indices(len(names), self.config.validation.pictures)]
        self._shown = views_named(
            gather_values(views_named(list(self.predictions.values()), shown)), shown
        )
        summary = summarise(self.scores())
        metrics = {f"validation/{name}": value for name, value in summary["model"].items()}
        metrics[ABOVE_BASELINES] = better_than_baselines(summary)
        self.log_dict(metrics, logger=False)
        self._record(metrics)

    def _record(self, metrics: dict[str, float]) -> None:
        """Log under the true step: the count that Lightning logs by shifts when a run resumes."""
        for logger in self.loggers if self.trainer.is_global_zero else ():
            logger.log_metrics(metrics, self.global_step)
            logger.save()

    def scores(self) -> pd.DataFrame:
        """Scores of the last validation, a row per view and method."""
        return pd.concat([self.tables[i] for i in sorted(self.tables)], ignore_index=True)

    def pictures(self) -> Prediction:
        """Views of the last validation, spread evenly over them, to be shown."""
        return self._shown

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """AdamW with a linear warm-up, as MegaScenes trains, and a late inverse-root decay."""
        model, trainer = self.config.model, self.config.trainer
        projection = list(self.model.cc_projection.parameters())
        others = [x for x in self.model.parameters() if all(x is not y for y in projection)]
        rate_of_projection = model.learning_rate * model.projection_rate
        groups: list[dict[str, Any]] = [
            {"params": others},
            {"params": projection, "lr": rate_of_projection},
        ]
        optimizer = torch.optim.AdamW(
            groups,
            lr=model.learning_rate,
            weight_decay=model.weight_decay,
            betas=(0.9, 0.99),
            fused=True,
        )
        rate = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: rate_at(step, trainer))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": rate, "interval": "step"}}


def rate_at(step: int, options: TrainerConfig) -> float:
    """Share of the learning rate at a step: linear warm-up, full, then falling as 1/√step."""
    warm = min(1.0, (step + 1) / max(1, options.warmup_steps))
    return warm * min(1.0, (options.lr_decay_start / max(1, step)) ** 0.5)
