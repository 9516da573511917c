"""How a model is trained, and what it is measured on."""

from dataclasses import dataclass

from extrap_train.config.options import option


@dataclass
class TrainerConfig:
    """How long, how often, on what."""

    steps: int = option(1200, "optimiser steps; more than a finished run has continue it", low=1)
    batch_size: int = option(16, "views per step and device", low=1)
    warmup_steps: int = option(
        100, "steps in which the learning rate rises to its full height", low=0
    )
    full_rate_steps: int = option(
        400,
        "steps at the full learning rate, which then falls as 1/sqrt(step), so that a run can be "
        "continued",
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
        known=("auto", "32-true", "bf16-mixed", "16-mixed"),
    )
    gradient_checkpointing: bool = option(
        False, "compute the denoiser's activations twice: less memory, more time"
    )
    compile: bool = option(
        False, "compile the denoiser: minutes at the start, faster steps on a GPU"
    )
    accelerator: str = option(
        "auto",
        "hardware to train on; auto takes a GPU if there is one",
        known=("auto", "cpu", "gpu", "cuda", "mps"),
    )
    devices: int = option(1, "GPUs, each with its own batch (distributed data parallel)", low=1)
    checkpoint_every: int = option(
        200, "steps between checkpoints; a killed run loses at most these", low=1
    )
    validate_every: int = option(
        400,
        "steps between validations, a multiple of trainer.checkpoint_every",
        low=1,
    )
    workers: int = option(
        0, "processes that load batches besides the training process", low=0, high=1024
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
