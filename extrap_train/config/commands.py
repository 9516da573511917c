"""The whole tree of each command."""

from dataclasses import dataclass, field

from extrap_train.config.completion import CompletionConfig
from extrap_train.config.data import CategoryConfig, DataConfig, PrepConfig
from extrap_train.config.depth import DepthConfig
from extrap_train.config.launcher import LauncherConfig
from extrap_train.config.matching import MatcherConfig
from extrap_train.config.model import ModelConfig, SamplerOptions
from extrap_train.config.scene import SceneOptions
from extrap_train.config.training import TrainerConfig, ValidationConfig
from extrap_train.config.tree import MISSING


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
    task: str = "category"
    seed: int = 0
    run: str | None = None
    """Name of the run's folder; by default made from the configuration, so that the same command
    resumes.
    """
    resume: bool = True
    output: str = "outputs"
    threads: int | None = None
    """CPU threads; null takes every core."""


@dataclass
class DataPrepConfig:
    """The whole tree of `python -m data_prep`."""

    category: CategoryConfig = MISSING
    data: DataConfig = MISSING
    depth: DepthConfig = MISSING
    matcher: MatcherConfig = MISSING
    launcher: LauncherConfig = MISSING
    prep: PrepConfig = field(default_factory=PrepConfig)
    output: str = "outputs"
    workers: int | None = None
    """Processes on this machine; null takes every core, but one process where a network for depth
    or matches runs on a GPU."""
