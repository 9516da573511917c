"""How a model is trained, and what it is measured on."""

from dataclasses import dataclass


@dataclass
class TrainerConfig:
    """How long, how often, on what."""

    steps: int = 1200
    """Optimiser steps; more than a finished run has prolong it."""
    batch_size: int = 16
    """Views a step and device."""
    warmup_steps: int = 100
    """Steps in which the learning rate rises to its full height."""
    full_rate_steps: int = 400
    """Steps at the full learning rate; from there it falls as 1/√step (Karras et al. 2024), which,
    unlike a decay towards a last step, leaves a run that can be prolonged.
    """
    condition_dropout: float = 0.05
    """Share of the training examples whose condition is the null condition."""
    min_snr: float | None = None
    """Greatest weight of a noise level by its signal-to-noise ratio (Hang et al. 2023: 5); null
    weighs all alike.
    """
    ema_decay: float = 0.999
    """Of the averaged weights; 0 keeps no average, which saves their memory."""
    precision: str = "bf16-mixed"
    """Lightning's name of it: `bf16-mixed`, `16-mixed` or `32-true`."""
    gradient_checkpointing: bool = False
    """Compute the denoiser's activations twice instead of keeping them: less memory, more time."""
    compile: bool = False
    """Compile the denoiser with torch.compile: minutes at the start, faster steps on a GPU."""
    accelerator: str = "auto"
    """`cpu`, `gpu`, or `auto`: a GPU where there is one."""
    devices: int = 1
    """GPUs, each with its own batch (distributed data parallel)."""
    checkpoint_every: int = 200
    """Steps; a killed run loses at most this many."""
    validate_every: int = 400
    """Steps; a multiple of `checkpoint_every`."""
    workers: int = 0
    """Processes that load batches beside the training process."""


@dataclass
class ValidationConfig:
    """What the trained model is measured on: held-out sequences."""

    examples: int = 60
    """Held-out views, spread evenly over the test pairs."""
    batch_size: int = 20
    """Views that are sampled at a time."""
    pictures: int = 8
    """Rows of the picture sheet."""
    lpips_weights: str | None = None
    """A full `lpips.LPIPS(net="squeeze")` state dict; null takes torchvision's cached backbone."""
