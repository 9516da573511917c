"""Figures that go with the numbers: contact sheets, curves and films."""

import itertools
import re
import shutil
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from jaxtyping import Float
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from extrap_train.data.image_files import png_bytes, to_eight_bits
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_file, partial_path, replace_synced, write_atomic

_HOLE_COLOUR = (1.0, 0.0, 1.0)
_MIN_TILE_PIXELS = 128
_FONT_PIXELS = 10
_FRAMES_PER_SECOND = 12
_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
_STEM_BYTES = 200
"""With what is put behind it, a name stays one that every file system takes."""


def colour_depth(depth: Float[Tensor, "b h w"]) -> Float[Tensor, "b 3 h w"]:
    """Near is yellow, far is blue, unknown is black; each picture over its own 2–98 % range."""
    pictures = []
    for one in depth:
        known = one > 0
        low, high = (
            one[known].quantile(torch.tensor([0.02, 0.98]).to(one)) if known.any() else (0, 1)
        )
        near = 1 - ((one - low) / max(float(high - low), 1e-12)).clamp(0, 1)
        colours = torch.from_numpy(plt.get_cmap("viridis")(near.cpu().numpy())[..., :3])
        pictures.append(torch.where(known[..., None].cpu(), colours, 0.0).permute(2, 0, 1).float())
    return torch.stack(pictures)


def mark_holes(
    image: Float[Tensor, "b 3 h w"], mask: Float[Tensor, "b h w"]
) -> Float[Tensor, "b 3 h w"]:
    """Holes in magenta, a colour that no photograph has by accident."""
    return torch.where(mask[:, None] > 0, image, image.new_tensor(_HOLE_COLOUR)[:, None, None])


def error_map(
    image: Float[Tensor, "b 3 h w"], truth: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, "b 3 h w"]:
    """Mean absolute colour difference, black to white over [0, ½]."""
    error = (image - truth).abs().mean(1, keepdim=True)
    return (2 * error).clamp(0, 1).expand(-1, 3, -1, -1)


def draw_contact_sheet(
    columns: dict[str, Float[Tensor, "b 3 h w"]], path: Path, captions: Sequence[str] = ()
) -> None:
    """Write a PNG with one row for each example and one titled column for each kind of picture.

    `captions`, one for each row or none at all, stand above the rows.
    """
    titles = list(columns)
    pictures = [columns[title].detach().float().cpu().clamp(0, 1) for title in titles]
    rows, height, width = len(pictures[0]), *pictures[0].shape[-2:]
    scale = max(1, round(_MIN_TILE_PIXELS / width))
    tile_height, tile_width = height * scale, width * scale
    strip, gap = 20, 4
    above = 16 if captions else 0
    pitch = above + tile_height + gap
    sheet = np.full((strip + rows * pitch, len(titles) * (tile_width + gap), 3), 255, np.uint8)
    for column, picture in enumerate(pictures):
        pixels = (picture * 255).round().byte().permute(0, 2, 3, 1).numpy()
        for row, tile in enumerate(pixels.repeat(scale, 1).repeat(scale, 2)):
            top, left = strip + row * pitch + above, column * (tile_width + gap)
            sheet[top : top + tile_height, left : left + tile_width] = tile
    texts = {(column * (tile_width + gap) + 4, 4): title for column, title in enumerate(titles)}
    if captions:
        said = zip(range(rows), captions, strict=True)
        texts |= {(4, strip + row * pitch + 1): " ".join(text.split()) for row, text in said}
    write_atomic(path, _draw_texts(sheet, texts))


def _draw_texts(sheet: np.ndarray, texts: dict[tuple[int, int], str]) -> bytes:
    """The sheet as PNG, with texts drawn on it at their upper left corners (x, y)."""
    picture = Image.fromarray(sheet)
    draw = ImageDraw.Draw(picture)
    # From matplotlib: Pillow's own font has no arrows and few letters.
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), _FONT_PIXELS)
    for place, text in texts.items():
        draw.text(place, text, fill=(0, 0, 0), font=font)
    return png_bytes(np.asarray(picture))


def plot_curve(steps: list[int], series: dict[str, list[float]], label: str, path: Path) -> None:
    """Plot lines over training steps, as PNG."""
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, values in series.items():
        axes.plot(steps, values, marker="o", markersize=3, label=name)
    axes.set_xlabel("training steps")
    axes.set_ylabel(label)
    axes.legend()
    save_figure(figure, path)


def plot_cameras(
    axes: Axes,
    offsets: Float[np.ndarray, "n 3"],
    forward: Float[np.ndarray, "n 3"],
    plane: Float[np.ndarray, "3 2"],
    colour: str,
    label: str = "",
) -> None:
    """Draw cameras as numbered arrows along their optical axes, projected onto a plane.

    A cross marks the point that their `offsets` are from; `forward` are unit vectors.
    """
    length = 0.2 * np.linalg.norm(offsets, axis=1).mean()
    (x, y), (u, v) = (offsets @ plane).T, length * (forward @ plane).T
    axes.quiver(
        x, y, u, v, color=colour, label=label,
        angles="xy", scale_units="xy", scale=1, width=0.006,
    )  # fmt: skip
    for number, (right, up) in enumerate(zip(x, y, strict=True), 1):
        outwards = np.array([right, up]) / max(np.hypot(right, up), 1e-9)
        axes.annotate(
            str(number), (right, up), 9 * outwards, textcoords="offset points",
            color=colour, fontsize=8, ha="center", va="center",
        )  # fmt: skip
    axes.plot(0, 0, "k+")
    axes.set_aspect("equal")


def save_figure(figure: Figure, path: Path, dpi: int = 100) -> None:
    """Write matplotlib's figure as PNG, and close it."""
    with atomic_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi)
    plt.close(figure)


def save_picture(image: Float[Tensor, "3 h w"], path: Path) -> None:
    """Write one picture as PNG."""
    write_atomic(path, png_bytes(to_eight_bits(image).transpose(1, 2, 0)))


def picture_names(names: Sequence[str]) -> list[str]:
    """One file name, without suffix or white space, for each of some names, which may be paths.

    They differ in more than their case, also with `_warp` appended to one of them.
    """
    taken: set[str] = set()
    chosen = []
    for name in names:
        path = PurePosixPath(name)
        plain = path.with_suffix("") if path.suffix.lower() in _PICTURES else path
        stem = "_".join(part for part in plain.parts if part not in ("/", "."))
        stem = re.sub(r"[^\w.+-]", "_", stem or "view")
        stem = stem.encode()[:_STEM_BYTES].decode(errors="ignore")
        numbered = (f"{stem}-{number}" for number in itertools.count(2))
        free = next(
            text
            for text in itertools.chain([stem], numbered)
            if not taken & {text.lower(), f"{text}_warp".lower()}
        )
        taken |= {free.lower(), f"{free}_warp".lower()}
        chosen.append(free)
    return chosen


def write_film(images: Float[Tensor, "n 3 h w"], path: Path) -> None:
    """Write pictures as an animation, GIF or MP4 by the file's suffix, small ones enlarged.

    The MP4 holds VP9, which browsers and players read; a GIF repeats for ever.
    """
    frames = _enlarge(to_eight_bits(images).transpose(0, 2, 3, 1))
    # A folder: the writers go by the file's suffix.
    temporary = partial_path(path)
    try:
        temporary.mkdir(parents=True, exist_ok=True)
        made = temporary / path.name
        if path.suffix == ".gif":
            _write_gif(frames, made)
        else:
            _write_mp4(frames, made)
        replace_synced(made, path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); free space or choose another "
            "folder"
        ) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _enlarge(pixels: np.ndarray) -> np.ndarray:
    """Enlarged by a whole number to at least a tile's size, with even sides, as video needs."""
    scale = max(1, round(_MIN_TILE_PIXELS / pixels.shape[2]))
    large = pixels.repeat(scale, 1).repeat(scale, 2)
    return np.ascontiguousarray(large[:, : large.shape[1] // 2 * 2, : large.shape[2] // 2 * 2])


def _write_gif(frames: np.ndarray, path: Path) -> None:
    first, *rest = [Image.fromarray(frame) for frame in frames]
    pause_ms = round(1000 / _FRAMES_PER_SECOND)
    first.save(path, save_all=True, append_images=rest, duration=pause_ms, loop=0)


def _write_mp4(frames: np.ndarray, path: Path) -> None:
    height, width = frames.shape[1:3]
    codec = cv2.VideoWriter.fourcc(*"vp09")
    writer = cv2.VideoWriter(str(path), codec, _FRAMES_PER_SECOND, (width, height))
    if not writer.isOpened():
        raise InputError(f"{path}: this OpenCV cannot write VP9 video; write a .gif instead")
    for frame in frames:
        writer.write(frame[..., ::-1])
    writer.release()
    if int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)) != len(frames):
        raise OSError("the video is cut off")  # OpenCV raises nothing on a full disk
