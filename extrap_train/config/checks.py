"""What types cannot say of options: ranges, known words, values that exclude each other."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from extrap_train.config.commands import DataPrepConfig, TrainConfig
from extrap_train.config.data import Co3dConfig, PrepConfig
from extrap_train.config.model import FAMILIES, NEAREST_ALONE, ModelConfig, SamplerConfig
from extrap_train.config.sampling import check_sampler, sampler_for
from extrap_train.config.training import TrainerConfig
from extrap_train.config.tree import dotted, require_one_of
from extrap_train.errors import InputError

_ACCELERATORS = ("auto", "cpu", "gpu", "cuda", "mps")
_PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")
"""Weights stay in single precision: in half, an optimiser's small steps would be lost."""

_ON_PAIRS = ("category", "validate")
"""Tasks that prepare pairs of photographs."""

BOUNDS: dict[str, tuple[float, float]] = {
    "seed": (0, 2**30),
    "threads": (1, math.inf),
    "workers": (1, math.inf),
    "data.test_sequences": (1, 10_000),
    "data.train_sequences": (1, 10_000),
    "data.frames": (2, 10_000),
    "data.image_size": (8, 8192),
    "data.seed": (0, 2**30),
    "depth.planes": (3, 4096),
    "depth.neighbours": (1, 64),
    "depth.image_size": (16, 8192),
    "depth.matcher.image_size": (16, 8192),
    "depth.matcher.keypoints": (2, 20_000),
    "matcher.image_size": (16, 8192),
    "matcher.keypoints": (2, 20_000),
    "launcher.tasks": (1, 1_000_000),
    "launcher.at_once": (1, 1_000_000),
    "launcher.cpus": (1, 1024),
    "launcher.memory_gib": (0.5, 4096),
    "launcher.hours": (0.02, 10_000),
    "prep.image_size": (1, 4096),
    "prep.min_pair_angle_deg": (0, 90),
    "prep.max_pair_angle_deg": (0, 90),
    "prep.min_viewpoint_quality": (-1e3, 1e3),
    "prep.min_point_cloud_quality": (-1e3, 1e3),
    "prep.max_gap_deg": (0, 360),
    "prep.min_coverage_deg": (0, 360),
    "prep.near_duplicate_deg": (0, 180),
    "model.image_size": (8, 4096),
    "model.warp_scale": (1, 8),
    "model.learning_rate": (1e-9, 1),
    "model.weight_decay": (0, 1),
    "prep.correction_grid": (4, 64),
    "prep.max_uses": (1, math.inf),
    "model.patch": (1, 64),
    "model.references": (1, 16),
    "model.octaves": (1, 16),
    "model.unet.layers_per_block": (1, 16),
    "model.unet.heads": (1, 64),
    "model.projection_rate": (0, math.inf),
    "model.unet.token_width": (1, 8192),
    "model.unet.norm_groups": (1, 1024),
    "model.vae.layers_per_block": (1, 16),
    "model.clip.width": (1, 8192),
    "model.clip.layers": (1, 64),
    "model.clip.heads": (1, 64),
    "model.clip.embedding_width": (1, 8192),
    "inputs": (1, 10_000),
    "minutes": (0.001, 10_000),
    "orbit": (1, 360),
    "frames": (1, 10_000),
    "painted_at_once": (1, 10_000),
    "lora.learning_rate": (1e-9, 1),
    "lora.rank": (1, 1024),
    "lora.virtual_references": (0, 1000),
    "lora.batch_size": (1, math.inf),
    "lora.steps": (1, math.inf),
    "lora.validate_every": (1, math.inf),
    "lora.patience": (1, math.inf),
    "sampler.steps": (1, 1000),
    "sampler.eta": (0, 1),
    "sampler.guidance": (0, 100),
    "sampler.guidance_rescale": (0, 1),
    "complete.step_deg": (1, 180),
    "complete.edges": (1, 64),
    "complete.tolerance": (1e-4, 0.5),
    "complete.exact_size": (16, 4096),
    "complete.held_out": (0, math.inf),
    "complete.port": (1, 65535),
    "complete.splats.iterations": (1, 1_000_000),
    "complete.splats.count": (1, 10_000_000),
    "complete.confidence.attempts": (1, 100),
    "complete.confidence.least_agreement": (0, 1),
    "complete.confidence.least_confidence": (0, 1),
    "trainer.steps": (1, math.inf),
    "trainer.batch_size": (1, math.inf),
    "trainer.warmup_steps": (0, math.inf),
    "trainer.full_rate_steps": (1, math.inf),
    "trainer.condition_dropout": (0, 1),
    "trainer.min_snr": (0.01, 1e6),
    "trainer.ema_decay": (0, 0.999999),
    "trainer.devices": (1, math.inf),
    "trainer.checkpoint_every": (1, math.inf),
    "trainer.validate_every": (1, math.inf),
    "trainer.workers": (0, 1024),
    "validation.examples": (1, math.inf),
    "validation.batch_size": (1, math.inf),
    "validation.pictures": (1, math.inf),
}
"""Least and greatest value of every number whose range its type does not say."""
BOUNDS |= {f"model.{name}": BOUNDS[name] for name in BOUNDS if name.startswith("sampler.")}


def validate(config: TrainConfig | DataPrepConfig, tasks: tuple[str, ...]) -> None:
    """Check what types cannot say; raises InputError with option, value and remedy."""
    _check_bounds(dotted(asdict(config)))
    _check_prep(config.prep)
    if isinstance(config.data, Co3dConfig) and not config.data.root:
        raise InputError("data=co3d needs the folder of the download: give data.root=FOLDER")
    if config.data.root and isinstance(config.data, Co3dConfig):
        _check_folder(config.data.root)
    _check_files(config)
    if isinstance(config, TrainConfig):
        require_one_of("task", config.task, tasks)
        require_one_of("trainer.precision", config.trainer.precision, _PRECISIONS)
        require_one_of("trainer.accelerator", config.trainer.accelerator, _ACCELERATORS)
        _check_intervals(config.trainer)
        _check_model(config.model)
        if config.task in _ON_PAIRS:
            _check_pairs(config.model, config.prep)
        _check_completion(config)
        _check_sampler_of(config)
        if config.lora.virtual_references == 1:
            raise InputError(
                "lora.virtual_references=1: one of every input's is held out; give 2 or more, or 0 "
                "for the inputs' own pairs"
            )


def _check_files(config: TrainConfig | DataPrepConfig) -> None:
    """Files of weights must be named before anything is computed that would want them."""
    options: dict[str, Any] = {
        "depth": config.depth,
        "depth.matcher": getattr(config.depth, "matcher", None),
        "matcher": getattr(config, "matcher", None),
    }
    for option, part in options.items():
        if hasattr(part, "checkpoint"):
            required_file(part.checkpoint, f"{option}.checkpoint", part.weights)


def required_file(path: str | None, option: str, content: str) -> str:
    """`path`, if it was given; else InputError that says what `option` wants."""
    if not path:
        raise InputError(f"{option} is not given: give {option}=FILE, {content}")
    return path


def _check_bounds(options: dict[str, Any]) -> None:
    for name, value in options.items():
        least, greatest = BOUNDS.get(name, (-math.inf, math.inf))
        if not isinstance(value, int | float) or least <= value <= greatest:
            continue
        if greatest == math.inf:
            raise InputError(f"{name}={value}: must be at least {least:g}")
        raise InputError(f"{name}={value}: must be from {least:g} to {greatest:g}")


def _check_prep(prep: PrepConfig) -> None:
    require_one_of("prep.full_circle", prep.full_circle, ("require", "prefer", "ignore"))
    if not 0 <= prep.min_pair_angle_deg < prep.max_pair_angle_deg <= 90:
        raise InputError(
            f"prep.min_pair_angle_deg={prep.min_pair_angle_deg} and "
            f"prep.max_pair_angle_deg={prep.max_pair_angle_deg}: need 0 ≤ min < max ≤ 90"
        )


def _check_model(model: ModelConfig) -> None:
    if model.geometry and model.family != "ours":
        raise InputError(
            f"model.geometry=true, but model.family={model.family} is told no depth of the warp: "
            "leave it out"
        )
    if model.references > 1 and model.family in NEAREST_ALONE:
        raise InputError(
            f"model.references={model.references}, but model.family={model.family} is told of the "
            "nearest alone: give model.references=1"
        )
    _check_network(model)


def _check_pairs(model: ModelConfig, prep: PrepConfig) -> None:
    """A model's warps are made from what is prepared."""
    if prep.image_size != model.warp_size:
        raise InputError(
            f"prep.image_size={prep.image_size}, but warps are made at model.warp_scale="
            f"{model.warp_scale} times model.image_size={model.image_size}: give "
            f"prep.image_size={model.warp_size}"
        )


def validate_model(model: ModelConfig) -> None:
    """Check what types cannot say of a model alone, as of one that was saved, like `validate`."""
    _check_bounds(dotted({"model": asdict(model)}))
    _check_network(model)
    check_sampler(model.sampler)


def _check_network(model: ModelConfig) -> None:
    require_one_of("model.prediction", model.prediction, ("epsilon", "v_prediction", "sample"))
    require_one_of("model.family", model.family, FAMILIES)
    if model.residual and model.family == "zeronvs":
        raise InputError(
            "model.residual=true needs a warp, which model.family=zeronvs is not told: give "
            "model.residual=false"
        )
    groups = model.unet.norm_groups
    odd = [width for width in model.unet.channels if width <= 0 or width % groups]
    if odd or not model.unet.channels:
        raise InputError(f"model.unet.channels={model.unet.channels}: need multiples of {groups}")
    if model.vae is not None and not model.vae.channels:
        raise InputError("model.vae.channels=[]: need a width a level")
    factor = model.patch if model.vae is None else 2 ** (len(model.vae.channels) - 1)
    coarsest = factor * 2 ** (len(model.unet.channels) - 1)
    if model.image_size % coarsest:
        raise InputError(
            f"model.image_size={model.image_size} is no multiple of {coarsest}, "
            "which the latents' factor and the levels of model.unet.channels need"
        )
    if len(model.unet.channels) != len(model.unet.attention_levels):
        raise InputError("model.unet.channels and model.unet.attention_levels differ in length")
    if model.zero_terminal_snr and model.prediction == "epsilon":
        raise InputError(
            "model.prediction=epsilon says nothing at zero terminal SNR: "
            "give model.zero_terminal_snr=false"
        )


def _check_intervals(trainer: TrainerConfig) -> None:
    """Validation looks at the averaged weights of a checkpoint."""
    if trainer.validate_every % trainer.checkpoint_every:
        raise InputError(
            f"trainer.validate_every={trainer.validate_every} is no multiple of "
            f"trainer.checkpoint_every={trainer.checkpoint_every}: give one that is"
        )


def _check_sampler_of(config: TrainConfig) -> None:
    """What other weights than the configured model's recommend is known when they are read."""
    if config.weights is None:
        sampler_for(config.sampler, config.model)
    else:
        check_sampler(config.sampler.over(SamplerConfig()))


def _check_completion(config: TrainConfig) -> None:
    complete = config.complete
    named = len(config.input_frames)
    if config.task == "complete" and (named or config.inputs) == 1:
        raise InputError(
            "one photograph does not show where its surfaces are; give at least two (inputs=3)"
        )
    require_one_of("complete.draw", complete.draw, ("one_sided", "spread"))
    require_one_of("complete.poses", complete.poses, ("orbit", "capture"))
    require_one_of("complete.generator", complete.generator, ("model", "exact"))


def _check_folder(root: str) -> None:
    """Before anything is written: a wrong root must not leave a run behind."""
    if not Path(root).is_dir():
        raise InputError(f"data.root={root}: no such folder; give the folder of the download")
