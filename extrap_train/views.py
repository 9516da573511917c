"""Data types shared by all packages: cameras, views, warps, batches.

Conventions: `extrap_train.geometry`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Bool, Float, Float16, UInt8
from torch import Tensor
from torch.nn import functional

T = TypeVar("T")
SAME_SURFACE = 0.02
"""Relative difference of depth below which a resampled map is interpolated."""


def combine(parts: Sequence[T], join: Callable[[list[Tensor]], Tensor]) -> T:
    """One value from several alike: tensors, in dataclasses of any depth, are joined (`torch.cat`).

    Whatever is not a tensor is taken from the first.
    """
    first: Any = parts[0]
    if isinstance(first, Tensor):
        return cast(T, join(cast(list[Tensor], [*parts])))
    if not is_dataclass(first) or isinstance(first, type):
        return cast(T, first)
    names = [field.name for field in fields(first)]
    joined = {name: combine([getattr(part, name) for part in parts], join) for name in names}
    return cast(T, replace(first, **joined))


def send(tensor: Tensor, target: torch.device | str | Tensor) -> Tensor:
    """`tensor.to(target)`, without waiting for a GPU to have it."""
    device = target.device if isinstance(target, Tensor) else torch.device(target)
    move = cast(Any, tensor.to)
    # An `mps` may read memory after it has been given back: pytorch/pytorch#83015.
    return cast(Tensor, move(target, non_blocking=device.type not in ("cpu", "mps")))


@dataclass(frozen=True)
class Camera:
    """One pinhole camera, or a batch of them that share an image size."""

    world_to_cam: Float[Tensor, "*b 4 4"]
    intrinsics: Float[Tensor, "*b 3 3"]
    height: int
    width: int

    @property
    def cam_to_world(self) -> Float[Tensor, "*b 4 4"]:
        """The inverse of `world_to_cam`, exact for rigid transforms."""
        rotation = self.world_to_cam[..., :3, :3].mT
        inverse = self.world_to_cam.clone()
        inverse[..., :3, :3] = rotation
        inverse[..., :3, 3:] = -rotation @ self.world_to_cam[..., :3, 3:]
        return inverse

    @property
    def center(self) -> Float[Tensor, "*b 3"]:
        """The camera's position in the world."""
        return self.cam_to_world[..., :3, 3]

    @property
    def forward(self) -> Float[Tensor, "*b 3"]:
        """The viewing direction in the world, unit length."""
        return self.world_to_cam[..., 2, :3]

    def cropped(self, top: int, left: int, height: int, width: int) -> "Camera":
        """The camera of the image's crop; the window may reach beyond the image."""
        shift = torch.zeros_like(self.intrinsics)
        shift[..., 0, 2], shift[..., 1, 2] = left, top
        return replace(self, intrinsics=self.intrinsics - shift, height=height, width=width)

    def resized(self, height: int, width: int) -> "Camera":
        """The camera of the image resampled to `height` × `width`."""
        rows = self.intrinsics.new_tensor([width / self.width, height / self.height, 1.0])
        return replace(self, intrinsics=self.intrinsics * rows[:, None], height=height, width=width)

    def squared(self, size: int) -> "Camera":
        """The camera of the image's largest centred square, resampled to `size` × `size`."""
        side = min(self.height, self.width)
        top, left = (self.height - side) // 2, (self.width - side) // 2
        return self.cropped(top, left, side, side).resized(size, size)

    def to(self, device: torch.device | str) -> "Camera":
        """The same camera on another device."""
        return combine([self], lambda tensors: tensors[0].to(device))

    def __getitem__(self, index: int | slice | tuple[int | slice, ...] | Tensor) -> "Camera":
        """Index the leading dimensions."""
        return replace(
            self, world_to_cam=self.world_to_cam[index], intrinsics=self.intrinsics[index]
        )


def stack_cameras(cameras: Sequence[Camera]) -> Camera:
    """One batched camera from several of the same image size (and the same leading dimensions)."""
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise ValueError(f"cameras of different image sizes cannot be stacked: {sorted(sizes)}")
    return combine(cameras, torch.stack)


def stack_poses(cameras: Sequence[Camera]) -> Camera:
    """One batched camera for its poses alone: sizes may differ, and the first one's is stated."""
    return Camera(
        torch.stack([camera.world_to_cam for camera in cameras]),
        torch.stack([camera.intrinsics for camera in cameras]),
        cameras[0].height,
        cameras[0].width,
    )


@dataclass(frozen=True)
class WholePhotograph:
    """The photograph that a view was cut from, as the capture has it."""

    path: str
    """Below the capture's root, with `/` between folders."""
    camera: Camera
    """Of the whole undistorted photograph, in the capture's own world."""


@dataclass(frozen=True)
class View:
    """A posed photograph, with its depth and object mask where they are known."""

    image: Float[Tensor, "3 h w"]
    camera: Camera
    depth: Float[Tensor, "h w"] | None = None
    mask: Float[Tensor, "h w"] | None = None
    name: str = ""
    photograph: WholePhotograph | None = None
    """None for a view that is no photograph of a capture, as a generated one."""

    def cropped(self, top: int, left: int, height: int, width: int) -> "View":
        """The view's crop; the window must lie inside the image."""
        inside = top >= 0 and left >= 0
        if not (
            inside and top + height <= self.camera.height and left + width <= self.camera.width
        ):
            raise ValueError(
                f"crop {height} x {width} at ({top}, {left}) leaves the "
                f"{self.camera.height} x {self.camera.width} image"
            )
        window = (..., slice(top, top + height), slice(left, left + width))
        return replace(
            self,
            image=self.image[window],
            camera=self.camera.cropped(top, left, height, width),
            depth=None if self.depth is None else self.depth[window],
            mask=None if self.mask is None else self.mask[window],
        )

    def resized(self, height: int, width: int) -> "View":
        """The view resampled: colours and mask by area, depth on its surfaces."""
        size = (height, width)
        return replace(
            self,
            image=_resample_area(self.image, size).clamp(0, 1),
            camera=self.camera.resized(height, width),
            depth=None if self.depth is None else resample_surfaces(self.depth[None], size)[0],
            mask=None
            if self.mask is None
            else _resample_area(self.mask[None], size)[0].clamp(0, 1),
        )

    def squared(self, size: int) -> "View":
        """The largest centred square of the view, resampled to `size` × `size`."""
        side = min(self.camera.height, self.camera.width)
        top, left = (self.camera.height - side) // 2, (self.camera.width - side) // 2
        return self.cropped(top, left, side, side).resized(size, size)


def _resample_area(
    image: Float[Tensor, "c h w"], size: tuple[int, int]
) -> Float[Tensor, "c h2 w2"]:
    return functional.interpolate(
        image[None], size, mode="bilinear", antialias=True, align_corners=False
    )[0]


def resample_surfaces(
    maps: Float[Tensor, "c h w"], size: tuple[int, int]
) -> Float[Tensor, "c h2 w2"]:
    """A depth map, the first of `maps`, and what lies on its surfaces, at another size.

    Interpolated on a surface, which leaves it where it was; by the nearest pixel at its edges, so
    that no depth is invented between two of them. Depth 0 is unknown.
    """
    nearest = functional.interpolate(maps[None], size, mode="nearest-exact")[0]
    smooth = functional.interpolate(maps[None], size, mode="bilinear", align_corners=False)[0]
    same = (smooth[0] - nearest[0]).abs() < SAME_SURFACE * nearest[0]
    return torch.where(same, smooth, nearest)


@dataclass(frozen=True)
class ViewPair:
    """What a training example is drawn from: frames of one sequence, references nearest first."""

    sequence: str
    query: int
    references: tuple[int, ...]
    score: float


@dataclass(frozen=True)
class Warp:
    """What the references show of the query view (paper II-A); zero where `mask` is 0."""

    image: Float[Tensor, "b 3 h w"]
    coordinates: Float[Tensor, "b 2 h w"]
    """Normalised (u, v) in the nearest reference, valid where `nearest_mask` is 1."""
    depth: Float[Tensor, "b h w"]
    weight: Float[Tensor, "b h w"]
    """Summed bilinear coverage; small at the rim of a hole."""
    mask: Float[Tensor, "b h w"]
    """1 where any reference reaches the pixel, else 0."""
    nearest_mask: Float[Tensor, "b h w"]
    """1 where the nearest reference, the one with index 0, reaches the pixel."""


@dataclass(frozen=True)
class FrameFeatures:
    """What frozen networks say of a batch's photographs, computed once per frame beforehand.

    The first dimensions are those of a batch, or of both orientations of one example.
    """

    target_mean: Float[Tensor, "*b z p q"]
    """Mean of the target's posterior in the autoencoder's latent space, not scaled."""
    target_std: Float[Tensor, "*b z p q"]
    reference_mean: Float[Tensor, "*b z p q"]
    """The same of the nearest reference."""
    reference_embedding: Float[Tensor, "*b d"]


@dataclass(frozen=True)
class PairBatch:
    """Examples: target view, up to `k` references (nearest first), and the warp between them."""

    image: Float[Tensor, "b 3 h w"]
    """NaN where the target is not known, or only its `features` are."""
    camera: Camera
    reference_images: Float[Tensor, "b k 3 h w"]
    reference_cameras: Camera
    reference_depths: Float[Tensor, "b k h w"]
    reference_valid: Bool[Tensor, "b k"]
    """False for a place without a reference: every example has at least one, the first."""
    reference_flows: Float[Tensor, "b k 2 g g"] | None = None
    """Where each reference's warp really belongs (`geometry.spline_flow`); None leaves all where
    they are."""
    object_mask: Bool[Tensor, "b h w"] | None = None
    """Where the target view shows the object; None where that is not known."""
    features: FrameFeatures | None = None
    """None where the frozen networks are to be asked."""
    warp: Warp | None = None
    """Made by `geometry.warp.compute_warp` once the batch is on its device; None until then."""

    def to(self, device: torch.device | str) -> "PairBatch":
        """The same batch on another device."""
        return combine([self], lambda tensors: tensors[0].to(device))


@dataclass(frozen=True)
class PackedBatch:
    """A `PairBatch` on its way to a device, as frames are stored: a third of its bytes."""

    image: UInt8[Tensor, "b 3 h w"] | None
    """None where `features` stand for it."""
    camera: Camera
    reference_images: UInt8[Tensor, "b k 3 h w"]
    reference_cameras: Camera
    reference_depths: Float16[Tensor, "b k h w"]
    depth_unit: Float[Tensor, " b"]
    reference_valid: Bool[Tensor, "b k"]
    reference_flows: Float[Tensor, "b k 2 g g"] | None = None
    object_mask: Bool[Tensor, "b h w"] | None = None
    features: FrameFeatures | None = None

    def to(self, device: torch.device | str) -> "PackedBatch":
        """The same batch on another device, which pinned memory reaches while others compute."""
        return combine([self], lambda tensors: send(tensors[0], device))

    def pin_memory(self) -> "PackedBatch":
        """The same batch in memory that a GPU copies from by itself; a DataLoader asks for it."""
        return combine([self], lambda tensors: tensors[0].pin_memory())

    def unpack(self) -> PairBatch:
        """Colours in [0, 1] and depth in scene units, in single precision."""
        references = _colours(self.reference_images)
        unknown = torch.full_like(references[:, 0], torch.nan)
        return PairBatch(
            image=unknown if self.image is None else _colours(self.image),
            camera=self.camera,
            reference_images=references,
            reference_cameras=self.reference_cameras,
            reference_depths=self.reference_depths.float() * self.depth_unit[:, None, None, None],
            reference_valid=self.reference_valid,
            reference_flows=self.reference_flows,
            object_mask=self.object_mask,
            features=combine([self.features], lambda tensors: tensors[0].float()),
        )


def _colours(image: UInt8[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 3 h w"]:
    return image.float().div_(255)
