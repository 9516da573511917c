"""What one option cannot say alone: values that exclude or need each other."""

from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from extrap_train.config.commands import PAIR_TASKS, DataPrepConfig, TrainConfig, TrainerConfig
from extrap_train.config.data_sources import (
    DownloadConfig,
    FilesDepthConfig,
    Mast3rConfig,
    MonocularConfig,
    PrepConfig,
    StereoConfig,
    SyntheticConfig,
)
from extrap_train.config.model_options import (
    NEAREST_ALONE,
    ModelConfig,
    SamplerConfig,
    SamplerOptions,
)
from extrap_train.config.options import check_options, packaged_names
from extrap_train.errors import InputError

_MAX_LEVELS = 8
_MAX_LATENTS, _MAX_WARP = 256, 4096
"""Sides of the latents and of the warp: beyond them a view takes tens of gigabytes."""
_PUBLISHED_STEPS = tuple(n for n in range(2, 501) if 1000 % n == 0)
"""Strides that go into the 1000 steps of the schedule without a rest."""


def validate(config: TrainConfig | DataPrepConfig) -> None:
    """Check every option and how they go together; raises InputError with option and remedy."""
    check_options(config)
    if config.shards is not None:
        check_shards_address(config.shards)
    _check_prep(config.prep)
    is_download = isinstance(config.data, DownloadConfig)
    if isinstance(config, TrainConfig) and config.task in PAIR_TASKS and config.shards:
        is_download = False  # the captures may be on another machine
    if is_download and not config.data.root:
        raise InputError(
            f"data={config.data.name} needs the folder of the captures: give data.root=FOLDER"
        )
    root = config.data.root
    if root and is_download and not Path(root).is_dir():
        # Before anything is written: a wrong root must not leave a run behind.
        raise InputError(f"data.root={root}: no such folder; give the folder of the captures")
    _check_files(config)
    if isinstance(config, DataPrepConfig) and config.model is not None:
        _check_encoder(config.model, config.prep)
    if isinstance(config, TrainConfig):
        _check_intervals(config.trainer)
        _check_model(config.model)
        if config.task in PAIR_TASKS:
            _check_pairs(config.model, config.prep)
        _check_inputs(config)
        if config.weights is None:
            sampler_for(config.sampler, config.model)
        else:  # what other weights recommend is known when they are read
            check_sampler(config.sampler.over(SamplerConfig()))
        if config.lora.virtual_references == 1:
            raise InputError(
                "lora.virtual_references=1: one per input is held out; give 2 or more, or 0 "
                "for the inputs' own pairs"
            )


def notes(config: TrainConfig | DataPrepConfig) -> list[str]:
    """What is allowed and may surprise, one line each."""
    if not isinstance(config, TrainConfig):
        return []
    found = [
        f"{option}={name}: the packaged model is meant; for the folder of that name here give "
        f"{option}=./{name}"
        for option, name in {"weights": config.weights, "model.start": config.model.start}.items()
        if name in packaged_names() and Path(str(name)).exists()
    ]
    if not isinstance(config.data, SyntheticConfig):
        return found
    model, size = config.model, config.data.image_size
    if config.task not in PAIR_TASKS or size <= model.warp_size:
        return found
    return [
        *found,
        f"data.image_size={size}: photographs are reduced to prep.image_size={model.warp_size} and "
        f"views generated at model.image_size={model.image_size}; for larger views give "
        f"model.image_size={size} prep.image_size={size * model.warp_scale}",
    ]


def _check_files(config: TrainConfig | DataPrepConfig) -> None:
    """Files of weights must be named before anything is computed that would want them."""
    options: dict[str, Any] = {
        "depth": config.depth,
        "depth.matcher": getattr(config.depth, "matcher", None),
        "matcher": getattr(config, "matcher", None),
        "poses": getattr(config, "poses", None),
    }
    for option, part in options.items():
        if hasattr(part, "checkpoint"):
            required_file(part.checkpoint, f"{option}.checkpoint", part.weights)
    if isinstance(config.depth, FilesDepthConfig):
        required_folder(config.depth.folder, "depth.folder", "the folder of the depth maps")


def required_file(path: str | None, option: str, content: str) -> str:
    """`path`, if it was given; else InputError that says what `option` wants."""
    if not path:
        raise InputError(f"{option} is not given: give {option}=FILE, {content}")
    return path


def required_folder(path: str | None, option: str, content: str) -> Path:
    """`path`, if it is a folder; else InputError that says what `option` wants."""
    if not path or not Path(path).is_dir():
        raise InputError(f"{option}={path or ''}: is no folder; give {option}=FOLDER, {content}")
    return Path(path)


def _check_prep(prep: PrepConfig) -> None:
    if not prep.min_pair_angle_deg < prep.max_pair_angle_deg:
        raise InputError(
            f"prep.min_pair_angle_deg={prep.min_pair_angle_deg} and "
            f"prep.max_pair_angle_deg={prep.max_pair_angle_deg}: need min < max"
        )


def _check_model(model: ModelConfig) -> None:
    if model.geometry and model.family != "ours":
        raise InputError(
            f"model.geometry=true: model.family={model.family} is not conditioned on the warp's "
            "depth; leave it out"
        )
    if model.references > 1 and model.family in NEAREST_ALONE:
        raise InputError(
            f"model.references={model.references}: model.family={model.family} is conditioned on "
            "the nearest alone; give model.references=1"
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


def _check_encoder(model: ModelConfig, prep: PrepConfig) -> None:
    """`data_prep` takes a model for its frozen networks alone."""
    if model.vae is None or model.clip is None:
        raise InputError(
            f"model={model.name} has no frozen networks that could encode frames beforehand; "
            "leave it out"
        )
    _check_model(model)
    _check_pairs(model, prep)


def validate_model(model: ModelConfig) -> None:
    """Check what types cannot say of a model alone, as of one that was saved, like `validate`."""
    check_options(model, "model.")
    _check_network(model)
    check_sampler(model.sampler)


def _check_network(model: ModelConfig) -> None:
    if model.residual and model.family == "zeronvs":
        raise InputError(
            "model.residual=true needs a warp, which model.family=zeronvs is not conditioned on; "
            "give model.residual=false"
        )
    groups = model.unet.norm_groups
    odd = [width for width in model.unet.channels if width % groups]
    if odd or not model.unet.channels:
        raise InputError(f"model.unet.channels={model.unet.channels}: need multiples of {groups}")
    if model.vae is not None and not model.vae.channels:
        raise InputError("model.vae.channels=[]: give one width per level")
    for part, channels in (
        ("unet", model.unet.channels),
        ("vae", model.vae.channels if model.vae else []),
    ):
        if len(channels) > _MAX_LEVELS:
            raise InputError(f"model.{part}.channels: need at most {_MAX_LEVELS} levels")
    factor = model.patch if model.vae is None else 2 ** (len(model.vae.channels) - 1)
    if model.image_size > _MAX_LATENTS * factor or model.warp_size > _MAX_WARP:
        raise InputError(
            f"model.image_size={model.image_size} with model.warp_scale={model.warp_scale}: need "
            f"at most {_MAX_LATENTS * factor} pixels, and {_MAX_WARP} of the warp"
        )
    coarsest = factor * 2 ** (len(model.unet.channels) - 1)
    if model.image_size % coarsest:
        raise InputError(
            f"model.image_size={model.image_size} is not a multiple of {coarsest}, "
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
            f"trainer.validate_every={trainer.validate_every} is not a multiple of "
            f"trainer.checkpoint_every={trainer.checkpoint_every}: give one that is"
        )


def _check_inputs(config: TrainConfig) -> None:
    named = len(config.input_frames)
    if named and config.inputs is not None:
        raise InputError(
            f"inputs={config.inputs} and input_frames ({named} frames) are both given; give only "
            "one of them"
        )
    if config.task == "complete" and (named or config.inputs) == 1:
        raise InputError(
            "one photograph does not show where its surfaces are; give at least two (inputs=3)"
        )
    estimated = isinstance(config.depth, StereoConfig | Mast3rConfig | MonocularConfig)
    if config.task in ("view", "scene") and estimated and (named or config.inputs) == 1:
        raise InputError(
            f"depth={config.depth.name} compares photographs, and only one is given; give at least "
            "two (inputs=3)"
        )


def sampler_for(options: SamplerOptions, model: ModelConfig) -> SamplerConfig:
    """How a model's views are sampled: as it recommends, but for what the options say.

    Raises InputError where the two do not go together.
    """
    sampler = options.over(model.sampler)
    check_sampler(sampler)
    if sampler.compat is not None:
        require_published(sampler, model.prediction, zero_terminal_snr=model.zero_terminal_snr)
    return sampler


def require_published(sampler: SamplerConfig, prediction: str, *, zero_terminal_snr: bool) -> None:
    """InputError where sampling as ZeroNVS and MegaScenes did (`compat`) says nothing of a model,
    or of a number of steps that they could not take.
    """
    option = f"sampler.compat={sampler.compat}"
    if prediction != "epsilon" or zero_terminal_snr:
        raise InputError(
            f"{option} samples as models were published that predict the noise, without zero "
            f"terminal SNR; this one predicts `{prediction}`: leave it out"
        )
    if sampler.steps not in _PUBLISHED_STEPS:
        raise InputError(
            f"{option} with sampler.steps={sampler.steps}: the published spacing needs one of "
            f"{', '.join(map(str, _PUBLISHED_STEPS))}, of which it leaves out the noisiest"
        )


def check_sampler(sampler: SamplerConfig) -> None:
    """InputError for settings that no model can be sampled with."""
    check_options(sampler, "sampler.")
    if sampler.solver != "ddim" and (sampler.eta > 0 or sampler.compat):
        raise InputError(
            f"sampler.solver={sampler.solver} is deterministic and none of the published runs: "
            "sampler.eta and sampler.compat need sampler.solver=ddim; without them, sampler.eta=0"
        )


def check_shards_address(address: str) -> None:
    """Raise InputError, which does not repeat it, for an address that contains credentials."""
    parts = urlsplit(address) if "://" in address else None
    if parts and ("@" in parts.netloc or parts.query or parts.fragment or "::" in address):
        raise InputError(
            "shards: an address may have no '@' before its first '/' and no '?', '#' or '::', as "
            "it is printed; give credentials in the environment variables of the store"
        )
