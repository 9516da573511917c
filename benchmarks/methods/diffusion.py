"""Diffusion methods as rows of a table: a model samples every target view, as it is or adapted to
the capture.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from lightning.fabric import Fabric
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from torch import Tensor
from torch.nn import functional

from benchmarks.methods.base import (
    SceneInputs,
    Stopwatch,
    Synthesis,
    Unavailable,
    photographs_used,
    views_with_depth,
)
from extrap_train.config import (
    FAMILIES,
    NEAREST_ALONE,
    LoraConfig,
    SamplerConfig,
    SamplerOptions,
    packaged_names,
    sampler_for,
)
from extrap_train.config.options import option, unset
from extrap_train.data.scene_pairs import adaptation_pairs
from extrap_train.diffusion.adaptation import adapt
from extrap_train.diffusion.generator import DiffusionGenerator
from extrap_train.diffusion.hub import is_repository, weights_folder
from extrap_train.diffusion.lora import temporary_adapter
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import (
    is_own,
    load_model,
    published_config,
    published_model,
    saved_config,
)
from extrap_train.diffusion.packaged import packaged_name
from extrap_train.diffusion.published.read import weights_at
from extrap_train.errors import InputError
from extrap_train.store.digests import model_files


@dataclass(frozen=True)
class Diffusion:
    """Samples the targets, each from its nearest inputs, with a trained model.

    A subclass that samples them otherwise has a `sample` of its own.
    """

    family: str = option(
        "ours",
        "what the model is conditioned on; the weights must be of this family",
        choices=FAMILIES,
    )
    weights: str | None = option(
        None,
        "model folder, published checkpoint, packaged model or repository, where `{category}` "
        "stands for the capture's; null: FAMILY-{category} for ours, FAMILY for the "
        "category-agnostic others",
    )
    references: int | None = option(
        None, "most inputs that a target is warped from; null: the model's number", low=1
    )
    steps: int | None = unset(SamplerConfig, "steps")
    """As the model recommends if it is null, and so are the next two."""
    guidance: float | None = unset(SamplerConfig, "guidance")
    eta: float | None = unset(SamplerConfig, "eta")

    def __post_init__(self) -> None:
        """InputError for options that exclude each other."""
        if (self.references or 1) > 1 and self.family in NEAREST_ALONE:
            raise InputError(
                f"references={self.references}, but {self.family} is conditioned on the "
                "nearest input alone: leave references= out"
            )

    def sampler(self, model: ExtrapolationModel) -> SamplerConfig:
        """How every view is sampled."""
        chosen = SamplerOptions(steps=self.steps, guidance=self.guidance, eta=self.eta)
        return sampler_for(chosen, model.config)

    def weight_files(self, category: str) -> Sequence[Path]:
        """The files of the model's folder, or the published checkpoint.

        Raises InputError for a model of another family.
        """
        place = self._place(category)
        config = saved_config(place) if is_own(place) else published_config(str(place))
        if config.family != self.family:
            raise InputError(
                f"{place}: is a model of the family {config.family}; give weights of {self.family}"
            )
        return list(model_files(place)) if place.is_dir() else [place]

    def synthesize(self, inputs: SceneInputs) -> Synthesis:
        """Generate every target.

        The time is a single image's share of all that the scene takes, compiling and loading aside.
        """
        place = self._place(inputs.category)
        model = _load_cached(place)
        self._warm_up(model, inputs)
        with Stopwatch() as watch:
            made = self.sample(model, inputs)
        size = (inputs.targets.height, inputs.targets.width)
        given = {"weights": _label(place), "depth": "used" if self.family != "zeronvs" else "scale"}
        given |= photographs_used(inputs.fine_views)
        if made.images.shape[-2:] != size:
            given["made at"] = f"{made.images.shape[-1]} px"
        return replace(
            made,
            images=_resample(made.images, size),
            seconds=watch.seconds / len(made.images),
            given=given | dict(made.given),
        )

    def sample(self, model: ExtrapolationModel, inputs: SceneInputs) -> Synthesis:
        """Every target from the inputs alone, at the model's own size, without the time.

        The model is shared: it stays as it is.
        """
        made = self.generator(model).generate(
            views_with_depth(inputs), inputs.targets, target_names(inputs), inputs.seed
        )
        given = {} if self.references is None else {"references": f"the nearest {self.references}"}
        return Synthesis(made.images, given=given)

    def generator(self, model: ExtrapolationModel) -> DiffusionGenerator:
        """What generates views with this method's options."""
        return DiffusionGenerator(model, self.sampler(model), references=self.references)

    def _warm_up(self, model: ExtrapolationModel, inputs: SceneInputs) -> None:
        """Generate in one step, so that kernels are compiled and chosen before the time is taken.

        A process's first pictures, and the first of each shape, wait for that.
        """
        generator = self.generator(model)
        quick = replace(generator, sampler=replace(generator.sampler, steps=1, compat=None))
        quick.generate(views_with_depth(inputs), inputs.targets, target_names(inputs), inputs.seed)

    def _place(self, category: str) -> Path:
        name = (self.weights or packaged_name(self.family, category)).replace(
            "{category}", category
        )
        if self.weights is not None and name not in packaged_names() and Path(name).exists():
            return weights_at(Path(name)) or Path(name)
        try:
            return weights_folder(name, "weights")
        except InputError as error:
            if is_repository(name):
                raise Unavailable(str(error)) from None
            is_ours = self.family == "ours"
            recipe = f"category={category}" if is_ours else f"experiment=small_{self.family}"
            raise Unavailable(
                f"no weights: {name} is no file or folder nor in the package; train them with "
                f"`python -m extrap_train {recipe}` and give the run's model/ folder as "
                f"options.METHOD.weights=FOLDER"
            ) from None


def _label(place: Path) -> str:
    """What a table calls weights: a run by its own name, whatever the folder within."""
    return place.resolve().parent.name if place.name == "model" else place.name


def target_names(inputs: SceneInputs) -> list[str]:
    """What the targets' noise is drawn by, the same for every method."""
    return [f"target {index}" for index in range(len(inputs.targets.world_to_cam))]


@lru_cache(2)
def _load_cached(place: Path) -> ExtrapolationModel:
    """A worker makes one cell after another, mostly with the same model."""
    opened = load_model(place) if is_own(place) else published_model(str(place))
    model = opened.eval().requires_grad_(False)
    return model.to("cuda") if torch.cuda.is_available() else model


def _resample(
    images: Float[Tensor, "n 3 h w"], size: tuple[int, int]
) -> Float[Tensor, "n 3 h2 w2"]:
    """At the table's size: a small model generates small pictures."""
    if images.shape[-2:] == size:
        return images.clamp(0, 1)
    resized = functional.interpolate(images, size, mode="bicubic", antialias=True)
    return resized.clamp(0, 1)


@dataclass(frozen=True)
class AdaptedDiffusion(Diffusion):
    """Trains an adapter on pairs made of the inputs, and generates the targets with it.

    The adapter is this scene's: the model is handed on as it was. Training is preprocessing and
    part of the time, which is spread over the scene's images as that of estimated depth is.
    """

    lora_steps: int = option(120, "most steps; the held-out pair may end it sooner", low=1)
    lora_minutes: float = option(
        30.0,
        "limit for slow machines, not meant to be reached: where it is, the images depend on the "
        "machine, and the row's inputs say so",
        unit="minutes",
        low=0.001,
    )

    def sample(self, model: ExtrapolationModel, inputs: SceneInputs) -> Synthesis:
        """Adapt, sample, and take the adapter off again."""
        views = [view.squared(model.config.warp_size) for view in views_with_depth(inputs)]
        options = LoraConfig(steps=self.lora_steps)
        pairs = adaptation_pairs(
            views, model.config.num_condition_views, options.virtual_references, inputs.seed
        )
        # One process of its own, also where a cluster runs the cell.
        alone = LightningEnvironment()
        device = next(model.parameters()).device.type
        with temporary_adapter(model, options, inputs.seed) as adapter:
            done = adapt(
                model,
                adapter,
                pairs,
                options,
                self.sampler(model),
                seconds=60 * self.lora_minutes,
                seed=inputs.seed,
                fabric=Fabric(accelerator=device, devices=1, plugins=alone),
            )
            made = super().sample(model, inputs)
        return replace(
            made,
            given={**made.given, "adaptation ended by": done.ended},
            counts={"adaptation_steps": float(done.steps), "kept_step": float(done.best_step)},
        )
