"""The whole tree of each command: how a model is trained and measured, and where jobs run."""

from dataclasses import dataclass, field

from extrap_train.config.data_sources import (
    CategoryConfig,
    DataConfig,
    DepthConfig,
    MatcherConfig,
    PrepConfig,
)
from extrap_train.config.model_options import ModelConfig, SamplerOptions
from extrap_train.config.options import MISSING, option
from extrap_train.config.scene_options import CompletionConfig, SceneOptions, StudioConfig


@dataclass
class TrainerConfig:
    """How long, how often, on what."""

    steps: int = option(1200, "optimiser steps; more than a finished run has continue it", low=1)
    batch_size: int = option(16, "views per step and device", low=1)
    warmup_steps: int = option(
        100, "steps in which the learning rate rises to its full height", low=0
    )
    lr_decay_start: int = option(
        400,
        "step from which the learning rate falls as 1/sqrt(step), so that a run can be continued",
        low=1,
    )
    condition_dropout: float = option(
        0.05, "share of the examples that are trained without their condition", low=0, high=1
    )
    min_snr: float | None = option(
        None,
        "clamp of the loss weight by signal-to-noise ratio (Hang et al. 2023: 5); null: no "
        "weighting",
        low=0.01,
        high=1e6,
    )
    ema_decay: float = option(
        0.999,
        "decay of the averaged weights; 0 keeps no average and saves its memory",
        low=0,
        high=0.999999,
    )
    precision: str = option(
        "auto",
        "Lightning's precision; weights stay in single precision; auto: bf16-mixed where the "
        "processor has units for it, else 32-true",
        choices=("auto", "32-true", "bf16-mixed", "16-mixed"),
    )
    gradient_checkpointing: bool = option(
        False, "compute the denoiser's activations twice: less memory, more time"
    )
    latents: str = option(
        "computed",
        "frozen networks' part of a step: computed, cached by data_prep with model=, or auto: "
        "cached if it is there",
        choices=("computed", "cached", "auto"),
    )
    compile: bool = option(
        False, "compile the denoiser: minutes at the start, faster steps on a GPU"
    )
    accelerator: str = option(
        "auto",
        "hardware to train on; auto takes a GPU if there is one",
        choices=("auto", "cpu", "gpu", "cuda", "mps"),
    )
    deterministic: bool = option(
        False,
        "repeat a GPU's training to the bit, where torch can; slower. A CPU always repeats itself",
    )
    devices: int = option(
        1, "GPUs of a machine, each with its own batch (distributed data parallel)", low=1
    )
    num_nodes: int = option(
        1,
        "machines that train together, each with its own devices; start with torchrun or srun",
        low=1,
    )
    checkpoint_every: int = option(
        200, "steps between checkpoints; a killed run loses at most these", low=1
    )
    validate_every: int = option(
        400,
        "steps between validations, a multiple of trainer.checkpoint_every",
        low=1,
    )
    workers: int = option(
        0,
        "processes that load batches besides the training process, at most one per core",
        low=0,
        high=1024,
    )


@dataclass
class LoggerConfig:
    """Where a training is logged."""

    name: str = option(
        "tensorboard",
        "where metrics, options and sample sheets go beside the run's folder; csv: nowhere else",
        choices=("csv", "mlflow", "tensorboard", "wandb"),
    )


@dataclass
class ValidationConfig:
    """What the trained model is measured on: held-out sequences."""

    examples: int = option(60, "held-out views, spread evenly over the test pairs", low=1)
    batch_size: int = option(20, "views sampled at a time", low=1)
    pictures: int = option(8, "rows of the picture sheet", low=1)
    lpips_weights: str | None = option(
        None,
        'full lpips.LPIPS(net="squeeze") state dict; null: torchvision\'s cached backbone',
    )


@dataclass
class LauncherConfig:
    """Where independent jobs run; one subclass per kind of place."""

    name: str = MISSING


@dataclass
class LocalConfig(LauncherConfig):
    """Processes on this machine, as many as `workers` says."""

    name: str = "local"


@dataclass
class SlurmConfig(LauncherConfig):
    """One SLURM job array; the command waits for it and gathers the results."""

    name: str = "slurm"
    partition: str | None = option(None, "partition of the job array")
    account: str | None = option(None, "account that the job array is charged to")
    tasks: int = option(
        200,
        "array tasks that the jobs are divided among; clusters allow 1001 by default",
        low=1,
        high=1_000_000,
    )
    at_once: int = option(50, "most array tasks that run at a time", low=1, high=1_000_000)
    cpus: int = option(1, "cores per task", low=1, high=1024)
    memory_gib: float = option(4.0, "memory per task", unit="GiB", low=0.5, high=4096)
    hours: float = option(
        4.0,
        "time limit of a task; unfinished jobs are submitted again, one per task",
        unit="hours",
        low=0.02,
        high=10_000,
    )
    directives: dict[str, str] = option(
        {}, "further sbatch options by their long names, as {constraint: avx512}"
    )


@dataclass
class RayConfig(LauncherConfig):
    """Tasks of a running Ray cluster; the command waits for them and gathers the results."""

    name: str = "ray"
    address: str = option(
        "auto", "HOST:PORT of the cluster; auto: $RAY_ADDRESS, or the one that this machine is in"
    )
    at_once: int = option(
        256, "most jobs that are handed to the cluster at a time", low=1, high=1_000_000
    )
    cpus: int = option(1, "cores per job", low=1, high=1024)
    gpus: float = option(0.0, "share of a GPU per job; a job with none sees no GPU", low=0, high=1)
    memory_gib: float = option(
        1.0, "memory that is reserved per job", unit="GiB", low=0.1, high=4096
    )


TASKS = {
    "category": "prepare a category, train its model, and measure it on held-out sequences",
    "check": "draw what proves or disproves a scene's poses, scale, lens and masks",
    "complete": "complete a scene all around: point cloud, views, Gaussians, turntable",
    "convert": "turn a published checkpoint (weights=FILE) into a model folder (to=FOLDER)",
    "depth": "train the network that gives the views of task=complete their depth",
    "pack": "write a trained model as a packaged one",
    "push": "upload a trained model to the Hugging Face hub (repo=org/name)",
    "scene": "adapt a model to one scene (LoRA)",
    "studio": "serve a page to drop photographs on, look at views, complete and download",
    "validate": "measure a trained model on held-out sequences",
    "view": "make one view of a scene (pose=) or a walk around it (orbit=)",
}
"""What each value of `task=` does."""
PAIR_TASKS = ("category", "validate")
"""Tasks that prepare pairs of photographs."""
ANY_CATEGORY_TASKS = ("check", "convert")
"""Tasks that have nothing to do with a category, so that none has to be given."""


@dataclass
class TrainConfig(SceneOptions):
    """The whole tree of `python -m extrap_train`."""

    category: CategoryConfig = MISSING
    data: DataConfig = MISSING
    depth: DepthConfig = MISSING
    matcher: MatcherConfig = MISSING
    poses: MatcherConfig = MISSING
    """Whose matches place photographs that come without cameras."""
    model: ModelConfig = MISSING
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    prep: PrepConfig = field(default_factory=PrepConfig)
    sampler: SamplerOptions = field(default_factory=SamplerOptions)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    complete: CompletionConfig = field(default_factory=CompletionConfig)
    studio: StudioConfig = field(default_factory=StudioConfig)
    task: str = option("category", "what to do; see Tasks", choices=tuple(TASKS))
    seed: int = option(0, "seed of everything random", low=0, high=2**30)
    run: str | None = option(
        None,
        "name of the run's folder; null: made from the options, so that the same command resumes",
    )
    to: str | None = option(None, "folder that task=convert writes")
    repo: str | None = option(None, "repository of the hub that task=push uploads to, as org/name")
    resume: bool = option(True, "continue or reuse what is there; false replaces it")
    shards: str | None = option(
        None, "folder or s3:// address of shards to train on; captures are then not needed"
    )
    output: str = option("outputs", "folder of all results")
    threads: int | None = option(None, "CPU threads; null: every core", low=1)


@dataclass
class DataPrepConfig:
    """The whole tree of `python -m data_prep`."""

    category: CategoryConfig = MISSING
    data: DataConfig = MISSING
    depth: DepthConfig = MISSING
    matcher: MatcherConfig = MISSING
    poses: MatcherConfig = MISSING
    """Whose matches place photographs that come without cameras (`data=folders`)."""
    launcher: LauncherConfig = MISSING
    model: ModelConfig | None = None
    """Whose frozen networks encode every training frame once, for trainer.latents=cached."""
    shards: str | None = option(
        None, "folder or s3:// address that the pairs are also written to, for training elsewhere"
    )
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
