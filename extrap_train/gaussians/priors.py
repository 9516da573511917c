"""Monocular depth for the methods that lean on it."""

from jaxtyping import Float
from torch import Tensor

from extrap_train.depth import DepthSource
from extrap_train.depth.surrogate import AffineSurrogate
from extrap_train.errors import InputError
from extrap_train.gaussians.scene import TrainingScene


def monocular_source(scene: TrainingScene, name: str) -> DepthSource:
    """`surrogate` (the scene's depth source under an unknown affine map) or `depth_source` itself.

    The second is for benchmarks whose depth source is a monocular network. The record says which.
    """
    match name:
        case "surrogate":
            scene.record["monocular"] = "surrogate: the depth source under an unknown affine map"
            return AffineSurrogate(scene.depth_source, scene.seed)
        case "depth_source":
            scene.record["monocular"] = "the depth source"
            return scene.depth_source
        case _:
            raise InputError(f"monocular={name} is unknown; known: surrogate, depth_source")


def prior_depths(
    scene: TrainingScene, source: DepthSource, device: str
) -> list[Float[Tensor, "h w"]]:
    """Depth of every input view up to an affine map, on `device`; 0 where it is unknown.

    The record says in how many inputs there is any: in others, depth losses are silent.
    """
    priors = [found.reliable() for found in source.depth_maps(scene.given)]
    known = sum(bool((prior > 0).any()) for prior in priors)
    scene.record["monocular depth"] = f"in {known} of {len(priors)} inputs"
    return [prior.to(device) for prior in priors]
