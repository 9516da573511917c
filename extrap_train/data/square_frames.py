"""From one capture's photographs to square frames with depth: what is stored, and what a scene's
model starts from.
"""

import hashlib
import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from extrap_train.data.frame_files import SequenceFrames
from extrap_train.data.image_files import to_eight_bits
from extrap_train.data.paths import file_stamp
from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.depth import DepthSource, NoDepthError
from extrap_train.errors import InputError, did_you_mean
from extrap_train.geometry.viewpoints import camera_centers, farthest_point_sample
from extrap_train.views import View, stack_cameras, stack_poses

HELD_OUT_EVERY = 5
"""A lone sequence holds out every fifth frame."""
MIN_KNOWN_SHARE = 0.25
"""Least share of known depths under a pixel of the coarser map for it to have one."""
MAX_UNUSABLE_SHARE = 0.1
"""Share of unusable frames beyond which the whole sequence is not trusted."""
MIN_FRAMES = 2
"""While so many are left, one unusable frame alone does not discredit a sequence."""
FRAMES_VERSION = 4
"""Raised whenever the same photographs give other frames."""
LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class CaptureKeys:
    """Hashes that tell captures apart without reading any photograph."""

    content: str
    """Digest of names, cameras and how files are read: the same wherever the capture lies."""
    files: str
    """Digest of sizes and times of the photographs, masks and depth maps."""
    sizes: str
    """Digest of their sizes alone: the same for a copy."""

    @classmethod
    def of(cls, sequence: FrameSequence) -> "CaptureKeys":
        """Looks at every file's entry in its folder."""
        content, files, sizes = hashlib.sha256(), hashlib.sha256(), hashlib.sha256()
        for frame in sequence.frames:
            traits = [frame.name, frame.camera.height, frame.camera.width, frame.has_depth]
            content.update(json.dumps([*traits, frame.has_mask, frame.reading]).encode())
            content.update(frame.camera.world_to_cam.numpy(force=True).tobytes())
            content.update(frame.camera.intrinsics.numpy(force=True).tobytes())
            stamps = [file_stamp(file) for file in frame.files]
            files.update(json.dumps(stamps).encode())
            sizes.update(json.dumps([stamp and stamp[0] for stamp in stamps]).encode())
        return cls(content.hexdigest(), files.hexdigest(), sizes.hexdigest())

    def frames_key(self, depth: str, image_size: int) -> str:
        """A hash of what frames are made from; `depth` says by what theirs is found."""
        made_from = [FRAMES_VERSION, image_size, depth, self.content, self.files]
        return hashlib.sha256(json.dumps(made_from).encode()).hexdigest()


def held_out_mask(frames: int) -> Bool[np.ndarray, " n"]:
    """Which frames of a lone sequence are for testing."""
    return np.arange(frames) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1


def make_frames(
    sequence: FrameSequence, depth_source: DepthSource, image_size: int, lone: bool
) -> SequenceFrames:
    """Read a sequence as squares around the object, with depth, at the store's size.

    The held-out frames of a `lone` sequence get no depth and lend none to the others: what is
    tested on must not shape the references.
    Frames whose files cannot be used are left out with a warning. Raises InputError where too many
    are, no mask shows the object, or no depth is known at all.
    """
    finer = max(1, (depth_source.image_size or 0) // image_size)
    where = f"sequence {sequence.category}/{sequence.name}"
    brought = depth_source.image_size is None
    views = _usable_views(sequence, where, image_size * finer, depth=brought)
    if all(view.mask is not None and not view.mask.any() for view in views):
        raise InputError(f"{where}: the masks are all black; remove them or the sequence")
    depths = torch.zeros(len(views), image_size, image_size)
    helping = (~held_out_mask(len(views)) if lone else np.ones(len(views), bool)).nonzero()[0]
    try:
        maps = depth_source.depth_maps([views[i] for i in helping])
    except NoDepthError as error:
        raise InputError(f"{where}: {error}") from None
    for index, found in zip(helping, maps, strict=True):
        depths[index] = block_median(found.reliable(), finer)
    views = [replace(view, depth=None).resized(image_size, image_size) for view in views]
    frames = SequenceFrames(
        names=tuple(view.name for view in views),
        camera=stack_cameras([view.camera for view in views]),
        images=np.stack([to_eight_bits(view.image).transpose(1, 2, 0) for view in views]),
        depths=depths.numpy(force=True),
        masks=np.stack([to_eight_bits(_mask(view)) for view in views]),
    )
    if not frames.depths.any():
        raise InputError(
            f"{where}: no depth is known in any of its frames; {_remedy(depth_source)}"
        )
    return frames


def select_input_frames(
    sequence: FrameSequence, names: Sequence[str], count: int | None
) -> list[int]:
    """Indices of a scene's input frames, in their order, for all tasks but `task=complete`, which
    has `reconstruction.inputs.choose_frames`.

    The frames that are named; else `count` spread by farthest point sampling of the positions; else
    all. Raises InputError where there are fewer.
    """
    known = [frame.name for frame in sequence.frames]
    where = f"scene {sequence.category}/{sequence.name}"
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(f"{where}: has no frame {unknown[0]}; {did_you_mean(unknown[0], known)}")
    if names:
        return sorted({known.index(name) for name in names})
    if count is None:
        return list(range(len(known)))
    if count > len(known):
        raise InputError(f"{where}: has {len(known)} frames, fewer than the {count} asked for")
    cameras = stack_poses([frame.camera for frame in sequence.frames])
    return sorted(farthest_point_sample(camera_centers(cameras), count).tolist())


def input_views(
    sequence: FrameSequence, chosen: Sequence[int], source: DepthSource, size: int
) -> list[View]:
    """The chosen frames as preparation makes them, `size` pixels square, with depth.

    Depth is estimated from these frames alone, so that the others can serve as truth.
    """
    chosen_frames = tuple(sequence.frames[index] for index in chosen)
    part = replace(sequence, frames=chosen_frames, left_out=())
    frames = make_frames(part, source, size, lone=False)
    return [
        View(
            _unit(frames.images[i]).permute(2, 0, 1).contiguous(),
            frames.camera[i],
            torch.from_numpy(frames.depths[i]),
            _unit(frames.masks[i]),
            name,
        )
        for i, name in enumerate(frames.names)
    ]


def target_views(frames: Sequence[Frame], size: int) -> list[View]:
    """Frames framed in the same way, without depth: what a generated view is compared with."""
    return [object_square(view, size) for view in load_held_out(frames)]


def load_held_out(frames: Sequence[Frame]) -> Iterator[View]:
    """The photographs without depth; those that cannot be read are left out with a warning."""
    reasons: list[str] = []
    yield from load_readable(frames, reasons, depth=False)
    if reasons:
        LOG.warning("%d held-out photographs are left out: %s", len(reasons), reasons[0])


def _remedy(source: DepthSource) -> str:
    """For a sequence without any depth: only depth that comes with the data can be estimated."""
    if source.image_size is None:
        return "use depth=stereo"
    return "check for blank photographs or wrong poses, or remove the sequence"


def _usable_views(sequence: FrameSequence, where: str, size: int, *, depth: bool) -> list[View]:
    reasons = list(sequence.left_out)
    whole = load_readable(sequence.frames, reasons, depth=depth)
    views = [object_square(view, size) for view in whole]
    require_few_unusable(reasons, sequence, where)
    return views


def load_readable(frames: Iterable[Frame], reasons: list[str], *, depth: bool) -> Iterator[View]:
    """The frames that can be read, one at a time; why the others cannot is added to `reasons`."""
    for frame in frames:
        try:
            view = replace(frame.load(depth=depth), name=frame.name)
        except InputError as error:
            reasons.append(str(error))
        else:
            yield view


def require_few_unusable(reasons: Sequence[str], sequence: FrameSequence, where: str) -> None:
    """Warn of a sequence's unusable frames, one reason each; InputError where they are too many."""
    if too_many := too_many_unusable(reasons, sequence):
        raise InputError(f"{where}: {too_many}")
    if reasons:
        LOG.warning("%s: %d frames left out: %s", where, len(reasons), reasons[0])


def too_many_unusable(reasons: Sequence[str], sequence: FrameSequence) -> str:
    """Why a sequence is not trusted with these unusable frames, one reason each; empty if it is."""
    count = len(sequence.frames) + len(sequence.left_out)
    allowed = max(MAX_UNUSABLE_SHARE * count, 1 if count > MIN_FRAMES else 0)
    if len(reasons) <= allowed:
        return ""
    return f"{len(reasons)} of {count} frames cannot be used, the first because of {reasons[0]}"


def object_square(view: View, size: int) -> View:
    """The largest square inside the image, as near to the object as it gets, resampled."""
    height, width = view.camera.height, view.camera.width
    side = min(height, width)
    v, u = _object_middle(view)
    top = min(max(round(v - side / 2), 0), height - side)
    left = min(max(round(u - side / 2), 0), width - side)
    return view.cropped(top, left, side, side).resized(size, size)


def _object_middle(view: View) -> tuple[float, float]:
    """(v, u) of the middle of the mask's bounding box; without an object, of the image."""
    inside = torch.zeros(0, 2) if view.mask is None else (view.mask > 0.5).nonzero().float()
    if not len(inside):
        return view.camera.height / 2, view.camera.width / 2
    v, u = (inside.amin(0) + inside.amax(0) + 1) / 2
    return float(v), float(u)


def _mask(view: View) -> Float[Tensor, "h w"]:
    return torch.ones_like(view.image[0]) if view.mask is None else view.mask


def block_median(depth: Float[Tensor, "h w"], side: int) -> Float[Tensor, "h2 w2"]:
    """The median of the known depths in each block of `side`² pixels; 0 where too few are known.

    A median is one of the depths (the lower of two in the middle), so that edges stay edges.
    """
    rows, columns = depth.shape[0] // side, depth.shape[1] // side
    blocks = depth.float().view(rows, side, columns, side).transpose(1, 2).flatten(2)
    known = blocks.isfinite() & (blocks > 0)
    median = torch.where(known, blocks, torch.nan).nanmedian(-1).values
    return torch.where(known.float().mean(-1) >= MIN_KNOWN_SHARE, median, 0)


def _unit(pixels: UInt8[np.ndarray, "..."]) -> Float[Tensor, "..."]:
    return torch.from_numpy(pixels).float().div_(255)
