"""A diffusion method that adapts its model to the capture before it paints (paper II-B)."""

from dataclasses import dataclass, replace

from lightning.fabric import Fabric
from lightning.fabric.plugins.environments.lightning import LightningEnvironment

from benchmarks.methods.base import SceneInputs
from benchmarks.methods.diffusion import Diffusion, Painted
from benchmarks.methods.references import views_with_depth
from extrap_train.config import LoraConfig
from extrap_train.data.scene_pairs import adaptation_pairs
from extrap_train.diffusion.adaptation import adapt
from extrap_train.diffusion.lora import temporary_adapter
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.gaussians.checks import check_range


@dataclass(frozen=True)
class AdaptedDiffusion(Diffusion):
    """Trains an adapter on pairs made of the inputs, and paints with it (METHOD §4).

    The adapter is this scene's: the model is handed on as it was. Training is preprocessing and
    part of the time, which is spread over the scene's images as that of estimated depth is.
    """

    lora_steps: int = 120
    """Most steps; the held-out pair may end it sooner."""
    lora_minutes: float = 30.0
    """Limit for slow machines. It is not meant to be reached: where it is, the images depend on
    the machine, and `given` says so.
    """

    def __post_init__(self) -> None:
        """InputError for the first option that cannot be meant."""
        super().__post_init__()
        check_range("lora_steps", self.lora_steps, 1)
        check_range("lora_minutes", self.lora_minutes, 0.001)

    def painted(self, model: ExtrapolationModel, inputs: SceneInputs) -> Painted:
        """Adapt, paint, and take the adapter off again."""
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
            made = super().painted(model, inputs)
        return replace(
            made,
            given={**made.given, "adaptation ended by": done.ended},
            counts={"adaptation_steps": float(done.steps), "kept_step": float(done.best_step)},
        )
