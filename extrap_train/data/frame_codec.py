"""How one stored frame becomes bytes: its photograph as JPEG or PNG, the rest without loss."""

import io

import cv2
import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float16, UInt8, UInt16
from PIL import Image, UnidentifiedImageError

from extrap_train.geometry.compiled import compiled

LOSSY_FROM = 256
"""Side of a frame, in pixels, from which its photograph is a JPEG; smaller ones are PNGs, without
loss.

A capture's photographs are JPEGs themselves, and larger. Of the colours a JPEG keeps a quarter of
the pixels, which is what a model of half the size sees of them.
"""
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95]
_ZSTD = pa.Codec("zstd", compression_level=1)


def encode_image(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """The photograph as the content of a JPEG or PNG file."""
    suffix, options = (".jpg", _QUALITY) if min(image.shape[:2]) >= LOSSY_FROM else (".png", [])
    _, content = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    return content.tobytes()


def decode_image(content: UInt8[np.ndarray, " n"], side: int) -> UInt8[np.ndarray, "3 h w"]:
    """The photograph, of side × side pixels; ValueError where it is none of that size."""
    try:  # the header alone, before memory for pixels is asked for
        found = Image.open(io.BytesIO(content.data), formats=("JPEG", "PNG")).size
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
        raise ValueError(f"no photograph ({type(error).__name__})") from None
    image = cv2.imdecode(content, cv2.IMREAD_COLOR_RGB) if found == (side, side) else None
    if image is None:
        raise ValueError(f"no photograph of {side} x {side} pixels")
    planes = np.empty((3, side, side), np.uint8)
    cv2.split(image, list(planes))  # six times as fast as a copy of the transposed array
    return planes


def encode_depth(depth: Float16[np.ndarray, "h w"]) -> bytes:
    """The depth map, compressed: differences along its rows, low and high bytes apart, Zstandard.

    As whole numbers its bits grow with the depth, so that neighbours on a surface differ little.
    """
    return _ZSTD.compress(_row_differences(np.ascontiguousarray(depth).view(np.uint16)).data, True)


def decode_depth(content: UInt8[np.ndarray, " n"], side: int) -> Float16[np.ndarray, "h w"]:
    """The depth map, of side × side pixels; ValueError where it is none of that size."""
    buffer = _decompress(content, 2 * side * side, f"depth map of {side} x {side} pixels")
    planes = np.frombuffer(buffer, np.uint8).reshape(2, side, side)
    return _row_sums(planes).view(np.float16)


def encode_mask(mask: Bool[np.ndarray, "h w"]) -> bytes:
    """The object's mask, a bit a pixel, compressed."""
    return _ZSTD.compress(np.packbits(mask).data, True)


def decode_mask(content: UInt8[np.ndarray, " n"], side: int) -> Bool[np.ndarray, "h w"]:
    """The object's mask, of side × side pixels; ValueError where it is none of that size."""
    size = -(-side * side // 8)
    bits = np.frombuffer(_decompress(content, size, f"mask of {side} x {side} pixels"), np.uint8)
    return np.unpackbits(bits, count=side * side).reshape(side, side).astype(bool)


def _decompress(content: UInt8[np.ndarray, " n"], size: int, what: str) -> pa.Buffer:
    """The `size` bytes that were compressed; ValueError where it is not `what`."""
    try:
        buffer = _ZSTD.decompress(pa.py_buffer(content), size)
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"no {what} ({error})") from None
    if buffer.size != size:
        raise ValueError(f"no {what}")
    return buffer


@compiled()
def _row_differences(values: UInt16[np.ndarray, "h w"]) -> UInt8[np.ndarray, "2 h w"]:
    """Low and high bytes of each difference to the left, the sign as its lowest bit."""
    height, width = values.shape
    planes = np.empty((2, height, width), np.uint8)
    for y in range(height):
        before = np.int64(0)
        for x in range(width):
            value = np.int64(values[y, x])
            difference = (value - before + 0x8000) % 0x10000 - 0x8000
            folded = 2 * difference if difference >= 0 else -2 * difference - 1
            planes[0, y, x], planes[1, y, x] = folded & 0xFF, folded >> 8
            before = value
    return planes


@compiled()
def _row_sums(planes: UInt8[np.ndarray, "2 h w"]) -> UInt16[np.ndarray, "h w"]:
    """The inverse of `_row_differences`."""
    _, height, width = planes.shape
    values = np.empty((height, width), np.uint16)
    for y in range(height):
        value = np.int64(0)
        for x in range(width):
            folded = np.int64(planes[0, y, x]) | np.int64(planes[1, y, x]) << 8
            value += (folded >> 1) ^ -(folded & 1)
            values[y, x] = value & 0xFFFF
    return values
