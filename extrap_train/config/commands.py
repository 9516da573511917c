"""The whole tree of each command."""

from dataclasses import dataclass, field

from extrap_train.config.completion import CompletionConfig
from extrap_train.config.data import CategoryConfig, DataConfig, PrepConfig
from extrap_train.config.depth import DepthConfig
from extrap_train.config.launcher import LauncherConfig
from extrap_train.config.matching import MatcherConfig
from extrap_train.config.model import ModelConfig, SamplerOptions
from extrap_train.config.options import MISSING, option
from extrap_train.config.scene import SceneOptions
from extrap_train.config.training import TrainerConfig, ValidationConfig

TASKS = {
    "category": "prepare a category, train its model, and measure it on held-out sequences",
    "complete": "complete a scene all around: point cloud, views, Gaussians, turntable",
    "depth": "train the network that gives the views of task=complete their depth",
    "pack": "write a trained model as a packaged one",
    "scene": "adapt a model to one scene (LoRA)",
    "validate": "measure a trained model on held-out sequences",
    "view": "make one view of a scene (pose=) or a walk around it (orbit=)",
}
"""What each value of `task=` does."""
PAIR_TASKS = ("category", "validate")
"""Tasks that prepare pairs of photographs."""


@dataclass
class TrainConfig(SceneOptions):
    """The whole tree of `python -m extrap_train`."""

    category: CategoryConfig = MISSING
    data: DataConfig = MISSING
    depth: DepthConfig = MISSING
    matcher: MatcherConfig = MISSING
    model: ModelConfig = MISSING
    prep: PrepConfig = field(default_factory=PrepConfig)
    sampler: SamplerOptions = field(default_factory=SamplerOptions)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    complete: CompletionConfig = field(default_factory=CompletionConfig)
    task: str = option("category", "what to do; see Tasks", known=tuple(TASKS))
    seed: int = option(0, "seed of everything random", low=0, high=2**30)
    run: str | None = option(
        None,
        "name of the run's folder; null: made from the options, so that the same command resumes",
    )
    resume: bool = option(True, "continue or reuse what is there; false replaces it")
    output: str = option("outputs", "folder of all results")
    threads: int | None = option(None, "CPU threads; null: every core", low=1)


@dataclass
class DataPrepConfig:
    """The whole tree of `python -m data_prep`."""

    category: CategoryConfig = MISSING
    data: DataConfig = MISSING
    depth: DepthConfig = MISSING
    matcher: MatcherConfig = MISSING
    launcher: LauncherConfig = MISSING
    prep: PrepConfig = field(default_factory=PrepConfig)
    output: str = option("outputs", "folder of all results")
    workers: int | None = option(
        None,
        "processes on this machine; null: one per thread, or one alone for a network on a GPU",
        low=1,
    )
    threads: int | None = option(
        None, "CPU threads of all processes together; null: every core", low=1
    )
