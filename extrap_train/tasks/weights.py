"""Which weights a task about one scene samples with."""

from pathlib import Path

import torch

from extrap_train.config import TrainConfig
from extrap_train.diffusion.checkpoint import load_model, packaged_weights
from extrap_train.diffusion.generator import DiffusionGenerator


def scene_generator(config: TrainConfig) -> tuple[DiffusionGenerator, Path]:
    """The generator of `weights`, or of the category's newest run, or of the packaged base; and
    where the weights are from.
    """
    newest = Path(config.output) / "train" / config.category.name / config.model.name / "latest"
    if config.weights is not None:
        given = Path(config.weights)
        folder = given if given.is_dir() else packaged_weights(config.weights)
    elif (newest / "model").is_dir():
        folder = newest / "model"
    else:
        folder = packaged_weights("base")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return DiffusionGenerator(load_model(folder).to(device).eval(), config.sampler), folder
