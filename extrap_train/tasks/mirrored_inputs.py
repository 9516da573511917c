"""The photographs that a scene is completed from, mirrored in the object's planes of symmetry."""

from collections.abc import Sequence

from rich.console import Console

from extrap_train.data.sequences import Frame
from extrap_train.reconstruction.capture_check import MASK_SHARES
from extrap_train.reconstruction.completion import with_masks
from extrap_train.reconstruction.global_map import GlobalMap, MapView
from extrap_train.reconstruction.symmetry import Symmetry, find_symmetries, mirrored_photographs


def mirror_inputs(
    inputs: GlobalMap, photographs: Sequence[Frame], console: Console
) -> tuple[tuple[Symmetry, ...], tuple[MapView, ...]]:
    """The symmetries that the photographs and their masks confirm, and the photographs mirrored in
    them; prints what was found.

    `inputs` are the map's views of these photographs, in their order. A mask that selects nearly
    the whole picture shows no object's outline and is left out.
    """
    size = inputs.views[0].camera.width
    masks = [frame.load(depth=False).squared(size).mask for frame in photographs]
    masks = [mask if mask is not None and mask.mean() <= MASK_SHARES[1] else None for mask in masks]
    if all(mask is None for mask in masks):
        console.print("symmetry: not sought, since no photograph has a mask of the object")
        return (), ()
    masked = with_masks(inputs, masks)
    found = find_symmetries(masked)
    for symmetry in found:
        console.print(
            f"symmetry: a plane maps {symmetry.agreement:.0%} of what is seen of the object onto "
            f"what is seen, and {symmetry.gain:.0%} to where no photograph looks"
        )
    if not found:
        console.print("symmetry: none that the photographs and their masks confirm")
    return found, mirrored_photographs(masked, found)
