"""How one stored frame becomes bytes: its photograph as JPEG or PNG, the rest without loss."""

import struct

import cv2
import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float16, UInt8, UInt16

from extrap_train.geometry.compiled import compiled

LOSSY_FROM = 256
"""Side of a frame, in pixels, from which its photograph is a JPEG; smaller ones are PNGs, without
loss.

A capture's photographs are JPEGs themselves, and larger. Of the colours a JPEG keeps a quarter of
the pixels, which is what a model of half the size sees of them.
"""
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95]
_HEADER_BYTES = 2048
_NO_FRAME = (0xC4, 0xC8, 0xCC)
"""Segments of a JPEG whose codes lie among those that begin a frame."""
_ZSTD = pa.Codec("zstd", compression_level=1)


def encode_image(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """The photograph as the content of a JPEG or PNG file."""
    suffix, options = (".jpg", _QUALITY) if min(image.shape[:2]) >= LOSSY_FROM else (".png", [])
    _, content = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    return content.tobytes()


def decode_image(
    content: UInt8[np.ndarray, " n"], planes: UInt8[np.ndarray, "3 side side"]
) -> None:
    """Fill `planes` with the photograph; ValueError where it is none of that size."""
    side = planes.shape[-1]
    # The header alone, before memory for pixels is asked for.
    is_of_that_size = _picture_size(content[:_HEADER_BYTES].tobytes()) == (side, side)
    image = cv2.imdecode(content, cv2.IMREAD_COLOR_RGB) if is_of_that_size else None
    if image is None:
        raise ValueError(f"no photograph of {side} x {side} pixels")
    cv2.split(image, list(planes))  # six times as fast as a copy of the transposed array


def _picture_size(header: bytes) -> tuple[int, int] | None:
    """Height and width that a JPEG or PNG states; PIL would take a third of the decoder's time."""
    if header.startswith(b"\x89PNG\r\n\x1a\n") and len(header) >= 24:
        width, height = struct.unpack(">II", header[16:24])
        return height, width
    at = 2 if header.startswith(b"\xff\xd8") else len(header)
    while at + 9 <= len(header):  # one segment after another: 0xff, what it is, its length
        mark, kind, length = struct.unpack(">BBH", header[at : at + 4])
        if mark != 0xFF:
            return None
        if 0xC0 <= kind <= 0xCF and kind not in _NO_FRAME:
            height, width = struct.unpack(">HH", header[at + 5 : at + 9])
            return height, width
        at += 2 + length
    return None


def encode_depth(depth: Float16[np.ndarray, "h w"]) -> bytes:
    """The depth map, compressed: differences down its columns, low and high bytes apart, Zstandard.

    As whole numbers its bits grow with the depth, so that neighbours on a surface differ little.
    Columns, because a processor adds the values of a row at once.
    """
    return _ZSTD.compress(
        _column_differences(np.ascontiguousarray(depth).view(np.uint16)).data, True
    )


def decode_depth(content: UInt8[np.ndarray, " n"], depth: Float16[np.ndarray, "side side"]) -> None:
    """Fill `depth` with the depth map; ValueError where it is none of that size."""
    side = len(depth)
    buffer = _decompress(content, 2 * side * side, f"depth map of {side} x {side} pixels")
    _add_columns(np.frombuffer(buffer, np.uint8).reshape(2, side, side), depth.view(np.uint16))


def encode_mask(mask: Bool[np.ndarray, "h w"]) -> bytes:
    """The object's mask, a bit a pixel, compressed."""
    return _ZSTD.compress(np.packbits(mask).data, True)


def decode_mask(content: UInt8[np.ndarray, " n"], mask: Bool[np.ndarray, "side side"]) -> None:
    """Fill `mask` with the object's mask; ValueError where it is none of that size."""
    side = len(mask)
    size = -(-side * side // 8)
    bits = np.frombuffer(_decompress(content, size, f"mask of {side} x {side} pixels"), np.uint8)
    mask[:] = np.unpackbits(bits, count=side * side).reshape(side, side)


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
def _column_differences(values: UInt16[np.ndarray, "h w"]) -> UInt8[np.ndarray, "2 h w"]:
    """Low and high bytes of each difference to the value above, the sign as its lowest bit."""
    height, width = values.shape
    planes = np.empty((2, height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            above = np.int64(values[y - 1, x]) if y else np.int64(0)
            difference = (np.int64(values[y, x]) - above + 0x8000) % 0x10000 - 0x8000
            folded = 2 * difference if difference >= 0 else -2 * difference - 1
            planes[0, y, x], planes[1, y, x] = folded & 0xFF, folded >> 8
    return planes


@compiled()
def _add_columns(planes: UInt8[np.ndarray, "2 h w"], values: UInt16[np.ndarray, "h w"]) -> None:
    """Fill `values` with the inverse of `_column_differences`."""
    _, height, width = planes.shape
    row = np.zeros(width, np.uint16)
    for y in range(height):
        for x in range(width):  # in 16 bits, of which a register holds many
            folded = np.uint16(planes[0, y, x]) | np.uint16(np.uint16(planes[1, y, x]) << 8)
            sign = np.uint16(np.uint16(0) - np.uint16(folded & np.uint16(1)))
            row[x] += np.uint16(np.uint16(folded >> 1) ^ sign)
        values[y] = row
