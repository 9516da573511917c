"""A diffusion method that first adapts its model to the capture (paper II-B)."""

from dataclasses import dataclass, replace

from lightning.fabric import Fabric
from lightning.fabric.plugins.environments.lightning import LightningEnvironment

from benchmarks.methods.base import SceneInputs, Synthesis, views_with_depth
from benchmarks.methods.diffusion import Diffusion
from extrap_train.config import LoraConfig
from extrap_train.config.options import option
from extrap_train.data.scene_pairs import adaptation_pairs
from extrap_train.diffusion.adaptation import adapt
from extrap_train.diffusion.lora import temporary_adapter
from extrap_train.diffusion.model import ExtrapolationModel


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
