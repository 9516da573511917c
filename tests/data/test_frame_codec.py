"""A frame's bytes: depth comes back to the bit, a photograph as a JPEG of high quality has it."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from extrap_train.data.co3d import read_category
from extrap_train.data.frame_codec import (
    LOSSY_FROM,
    decode_depth,
    decode_image,
    decode_mask,
    encode_depth,
    encode_image,
    encode_mask,
)
from extrap_train.data.image_files import to_eight_bits
from extrap_train.data.square_frames import object_square

KILOBYTE = 1000
CONTENTS = {
    "empty": b"",
    "text": b"no picture at all",
    "a cut JPEG": encode_image(np.full((256, 256, 3), 99, np.uint8))[:200],
    "a picture of another size": encode_image(np.zeros((32, 16, 3), np.uint8)),
    "another kind of picture": cv2.imencode(".bmp", np.zeros((16, 16, 3), np.uint8))[1].tobytes(),
    "a depth map of another size": encode_depth(np.zeros((8, 8), np.float16)),
    "a larger depth map": encode_depth(np.zeros((64, 64), np.float16)),
    "a larger mask": encode_mask(np.zeros((99, 99), bool)),
}


def _decoded(decode, content: bytes, side: int) -> np.ndarray:
    shape, dtype = {
        decode_image: ((3, side, side), np.uint8),
        decode_depth: ((side, side), np.float16),
        decode_mask: ((side, side), np.bool_),
    }[decode]
    target = np.empty(shape, dtype)
    decode(np.frombuffer(content, np.uint8), target)
    return target


@pytest.mark.parametrize("seed", range(3))
def test_any_depth_comes_back_to_the_bit(seed: int) -> None:
    """Every number of 16 bits, infinities and what is not a number among them, in any order."""
    numbers = np.random.default_rng(seed).permutation(2**16) if seed else np.arange(2**16)
    bits = numbers.astype(np.uint16).reshape(256, 256)
    depth = bits.view(np.float16)
    assert np.array_equal(_decoded(decode_depth, encode_depth(depth), 256).view(np.uint16), bits)


@given(mask=arrays(bool, (7, 7)))
@settings(max_examples=50, deadline=None)
def test_any_mask_comes_back(mask: np.ndarray) -> None:
    assert np.array_equal(_decoded(decode_mask, encode_mask(mask), 7), mask)


@given(pixels=arrays(np.uint8, (9, 9, 3)))
@settings(max_examples=50, deadline=None)
def test_a_small_photograph_comes_back_to_the_bit(pixels: np.ndarray) -> None:
    assert np.array_equal(
        _decoded(decode_image, encode_image(pixels), 9), pixels.transpose(2, 0, 1)
    )


@given(side=st.integers(LOSSY_FROM, 2 * LOSSY_FROM), seed=st.integers(0, 9))
@settings(max_examples=5, deadline=None)
def test_a_large_photograph_keeps_its_colours_and_their_order(side: int, seed: int) -> None:
    coarse = np.random.default_rng(seed).integers(0, 255, (8, 8, 3)).astype(np.uint8)
    image = cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    again = _decoded(decode_image, encode_image(image), side)
    error = again.transpose(1, 2, 0).astype(float) - image
    assert np.abs(error.mean((0, 1))).max() < 0.5
    assert (error**2).mean() < 4


@pytest.mark.parametrize("name", list(CONTENTS))
@pytest.mark.parametrize("decode", [decode_image, decode_depth, decode_mask])
def test_other_bytes_are_an_error(decode, name: str) -> None:
    with pytest.raises(ValueError, match="16 x 16"):
        _decoded(decode, CONTENTS[name], 16)


@pytest.mark.parametrize("category", ["apple", "hydrant"])
def test_frames_of_real_captures_stay_small(shared, category: str) -> None:
    """A frame of 512 pixels has at most 140 kB, and 40 dB against its photograph."""
    frame = read_category(shared / "data" / "co3d", category)[0].frames[0]
    image = to_eight_bits(object_square(frame.load(depth=False), 512).image).transpose(1, 2, 0)
    content = encode_image(np.ascontiguousarray(image))
    again = torch.from_numpy(_decoded(decode_image, content, 512)).double()
    error = (again - torch.from_numpy(image.transpose(2, 0, 1).copy())).square().mean()
    assert len(content) < 140 * KILOBYTE
    assert 10 * torch.log10(255**2 / error) > 40
