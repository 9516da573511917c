"""Damaged and hostile pictures, masks and depth maps: each is read or refused in one line.

`python -m pytest -m slow tests/data/test_fuzzed_pictures.py`
"""

import io
import multiprocessing
import os
import random
import resource
import struct
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.protocol.array_files import array_of, pictures_of
from extrap_train.data.depth_files import DepthFile
from extrap_train.data.image_files import (
    image_size,
    read_grey,
    read_mask,
    read_photograph,
)
from extrap_train.errors import InputError

SEED = 20
DAMAGES_EACH = 16
MAX_SECONDS = 20.0
MAX_MIB = 4096
SIZE = (24, 32)
PROGRAMS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "pickle.")


def read_depth(path: Path, size: tuple[int, int], scale: float = 1.0) -> torch.Tensor:
    return DepthFile(path.name, scale).read(path.parent, size)


def read_half_depth(path: Path, size: tuple[int, int]) -> torch.Tensor:
    return DepthFile(path.name, 1.0, is_half_float=True).read(path.parent, size)


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png(width: int, height: int, *chunks: bytes, depth: int = 8, colour: int = 0) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _png_chunk(b"IHDR", header) + b"".join(chunks)


def _saved(picture: Image.Image, kind: str, **options: object) -> bytes:
    content = io.BytesIO()
    picture.save(content, kind, **options)
    return content.getvalue()


def _array(values: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.save(content, values, allow_pickle=True)
    return content.getvalue()


def _npy(header: bytes, rest: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + rest


def sound_files() -> dict[str, bytes]:
    """What is damaged: one file of every kind that is read."""
    values = np.random.default_rng(SEED)
    rgb = Image.fromarray(values.integers(0, 256, (*SIZE, 3)).astype(np.uint8))
    alpha = Image.fromarray(values.integers(0, 256, (*SIZE, 4)).astype(np.uint8))
    depth = values.integers(0, 60_000, SIZE).astype(np.uint16)
    exif = Image.Exif()
    exif[0x0112], exif[0x010E] = 6, "upright"
    return {
        "rgb.png": _saved(rgb, "PNG", exif=exif),
        "alpha.png": _saved(alpha, "PNG"),
        "palette.png": _saved(rgb.quantize(), "PNG", transparency=3),
        "depth.png": _saved(Image.fromarray(depth), "PNG"),
        "bits.png": _saved(rgb.convert("1"), "PNG"),
        "photo.jpg": _saved(rgb, "JPEG", exif=exif),
        "print.jpg": _saved(rgb.convert("CMYK"), "JPEG"),
        "stereo.jpg": _saved(rgb, "MPO", save_all=True, append_images=[rgb]),
        "photo.webp": _saved(alpha, "WEBP", exif=exif),
        "photo.gif": _saved(rgb.quantize(), "GIF", transparency=0),
        "photo.bmp": _saved(rgb, "BMP"),
        "mask.pgm": _saved(rgb.convert("L"), "PPM"),
        "raw.tif": _saved(rgb, "TIFF", exif=exif),
        "lzw.tif": _saved(rgb, "TIFF", compression="tiff_lzw"),
        "jpeg.tif": _saved(rgb, "TIFF", compression="jpeg"),
        "depth.tif": _saved(Image.fromarray(depth.astype(np.float32)), "TIFF"),
        "depth.npy": _array(depth),
        "metres.npy": _array(depth.astype(np.float32)[..., None]),
    }


def damages(content: bytes, dice: random.Random) -> Iterator[bytes]:
    for index in range(DAMAGES_EACH):
        damaged = bytearray(content)
        where = dice.randrange(len(content))
        match index % 6:
            case 0:
                del damaged[where:]
            case 1:
                for _ in range(dice.randint(1, 12)):
                    damaged[dice.randrange(len(damaged))] = dice.randrange(256)
            case 2:  # where sizes and offsets stand
                start = dice.randrange(min(64, len(damaged)))
                damaged[start : start + 4] = dice.choice([b"\xff" * 4, b"\0" * 4, b"\x7f\xff" * 2])
            case 3:
                damaged[where:where] = dice.randbytes(dice.randint(1, 200))
            case 4:
                length = dice.randint(1, 64)
                damaged[where : where + length] = bytes([dice.choice((0, 255))]) * length
            case 5:
                del damaged[where : where + dice.randint(1, 30)]
        yield bytes(damaged)


class _Runs:
    """What pickle would run."""

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, ("touch executed",)


def hostile_files() -> dict[str, bytes]:
    """Made to cost memory or time, or to have something run."""
    black = zlib.compress(bytes(12_500 * 8_000 * 4 + 8_000), 9)
    text = zlib.compress(bytes(200_000_000), 9)
    postscript = _saved(Image.new("RGB", (32, 24)), "EPS")
    tiff = bytearray(_saved(Image.new("L", (32, 24)), "TIFF"))
    at = tiff.index(struct.pack("<HHI", 256, 4, 1))
    tiff[at + 8 : at + 12] = struct.pack("<I", 90_000_000)
    shape = "{'descr': '<f4', 'fortran_order': False, 'shape': %s}\n"
    arrays = {
        "huge": shape % "(1000000000, 1000000000)",
        "negative": shape % "(-24, 32)",
        "long": shape % str((1,) * 60),
        "nested": shape % ("(" * 5000),
        "code": "__import__('os').system('touch executed')",
        "many": shape % ("9" * 5000),
    }
    return {
        "limit.png": _png(12_500, 8_000, _png_chunk(b"IDAT", black), colour=6),
        "beyond.png": _png(60_000, 60_000, _png_chunk(b"IDAT", black)),
        "largest.png": _png(2**31 - 1, 2**31 - 1),
        "flat.png": _png(100_000_000, 1, _png_chunk(b"IDAT", black)),
        "text.png": _png(32, 24, _png_chunk(b"zTXt", b"a\0\0" + text)),
        "profile.png": _png(32, 24, _png_chunk(b"iCCP", b"a\0\0" + text)),
        "texts.png": _png(32, 24, *[_png_chunk(b"zTXt", b"a\0\0" + text[:3000])] * 2000),
        "wide.tif": bytes(tiff),
        "wide.gif": b"GIF89a\xff\xff\xff\xff\x80\0\0" + bytes(800),
        "wide.bmp": b"BM"
        + struct.pack("<IIIIiiHHIIiiII", 54, 0, 54, 40, 2**30, 2**30, 1, 24, *[0] * 6),
        "wide.pgm": b"P5 99999999999 99999999999 255\n",
        "float.pfm": b"Pf\n32 24\n-1e-300\n" + b"\xff" * 32 * 24 * 4,
        "postscript.png": postscript,
        "postscript.jpg": b"%!PS-Adobe-3.0\n%%BoundingBox: 0 0 32 24\n(executed) (w) file\n",
        "binary.eps": b"\xc5\xd0\xd3\xc6" + postscript,
        "drawing.svg": b'<svg xmlns="http://www.w3.org/2000/svg"><image href="file:///etc/passwd"/></svg>',
        "meta.png": b"\xd7\xcd\xc6\x9a" + bytes(100),
        "paper.jpg": b"%PDF-1.7\n",
        "phone.heic": b"\0\0\0\x18ftypheic" + b"\xff" * 400,
        "objects.npy": _array(np.array([_Runs()], dtype=object)),
        "zipped.npy": b"PK\x03\x04" + bytes(200),
        "nothing.png": b"",
        "nothing.npy": b"",
    } | {f"{name}.npy": _npy(header.encode(), bytes(64)) for name, header in arrays.items()}


def _write_all(folder: Path) -> int:
    dice = random.Random(SEED)
    suffixes = (".png", ".jpg", ".tif", ".npy")
    files = hostile_files()
    for name, content in sound_files().items():
        stem, suffix = name.split(".")
        files[f"{stem}_sound.{suffix}"] = content
        for index, damaged in enumerate(damages(content, dice)):
            other = suffix if index % 4 else dice.choice(suffixes)[1:]
            files[f"{stem}_{suffix}_{index}.{other}"] = damaged
    for name, content in files.items():
        (folder / name).write_bytes(content)
    os.mkfifo(folder / "pipe.png")
    os.mkfifo(folder / "pipe.npy")
    (folder / "folder.png").mkdir()
    (folder / "loop.png").symlink_to("loop.png")
    (folder / "device.npy").symlink_to("/dev/zero")
    return len(list(folder.iterdir()))


def _readings(path: Path) -> Iterator[Callable[[], object]]:
    def of_its_size() -> tuple[int, int]:
        try:
            return image_size(path)
        except InputError:
            return SIZE

    yield lambda: image_size(path)
    yield lambda: read_photograph(path, of_its_size())
    yield lambda: read_photograph(path, SIZE, path)
    yield lambda: read_mask(path, SIZE)
    yield lambda: read_grey(path, of_its_size())
    yield lambda: read_half_depth(path, of_its_size())
    yield lambda: read_depth(path, SIZE, 0.001)
    if path.is_file() and not path.is_symlink():
        content = path.read_bytes()
        yield lambda: pictures_of({path: content}, SIZE[0])
        yield lambda: array_of(content, (None, 3), path)


def _read_all(folder: Path) -> tuple[list[str], int]:
    """What went wrong, and the most memory that was used; in a process of its own."""
    for reading in _readings(folder / "rgb_sound.png"):  # plugins are imported meanwhile
        _read(reading)
    troubles: list[str] = []

    def watch(event: str, arguments: tuple[object, ...]) -> None:
        if event.startswith(PROGRAMS):
            troubles.append(f"{event} {arguments}")

    sys.addaudithook(watch)
    for path in sorted(folder.iterdir()):
        start = time.process_time()
        found = [_read(reading) for reading in _readings(path)]
        troubles.extend(f"{path.name}: {trouble}" for trouble in found if trouble)
        if time.process_time() - start > MAX_SECONDS:
            troubles.append(f"{path.name}: {time.process_time() - start:.1f} s")
    return troubles, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def _read(reading: Callable[[], object]) -> str:
    try:
        reading()
    except InputError as error:
        return f"more than a line: {error}" if "\n" in str(error) else ""
    except Exception as error:
        return repr(error)
    return ""


@pytest.mark.slow
def test_every_file_is_read_or_refused(tmp_path: Path) -> None:
    assert _write_all(tmp_path) >= 300
    there = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=there) as pool:
        troubles, most_mib = pool.submit(_read_all, tmp_path).result(timeout=1200)
    assert not troubles
    assert most_mib < MAX_MIB
    assert not (tmp_path / "executed").exists()
    assert not Path("executed").exists()
