"""Matchers behind one protocol: which points of two pictures show the same thing.

A matcher is added with one file (a class with the protocol `Matcher`) and one YAML under
`conf/matcher/` that names the class as `factory`. Pixels are (u, v) with centres at +0.5, as
everywhere; a flow says where a pixel of the *first* picture went in the *second*.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrap_train.geometry.cameras import pixel_grid


@dataclass(frozen=True)
class Matches:
    """Points of the first picture and where they are in the second; pixels (u, v)."""

    first: Float[Tensor, "n 2"]
    second: Float[Tensor, "n 2"]
    confidence: Float[Tensor, " n"]
    """In (0, 1]. Ranks matches of one matcher; is not a probability, nor comparable between two."""

    @property
    def first_to_second(self) -> Float[Tensor, "n 2"]:
        """How far, in pixels, each point went."""
        return self.second - self.first

    def __len__(self) -> int:
        """How many there are."""
        return len(self.confidence)

    def to(self, like: Tensor) -> "Matches":
        """The same on the device, and of the type, of another tensor."""
        return Matches(self.first.to(like), self.second.to(like), self.confidence.to(like))

    def __getitem__(self, index: Bool[Tensor, " n"] | Tensor | slice) -> "Matches":
        """Those at `index`."""
        return Matches(self.first[index], self.second[index], self.confidence[index])


@dataclass(frozen=True)
class DenseFlow:
    """For every pixel of the first picture, how far away it is in the second."""

    first_to_second: Float[Tensor, "h w 2"]
    """(u, v) in pixels, finite everywhere; means nothing where the confidence is 0."""
    confidence: Float[Tensor, "h w"]
    """In [0, 1]; 0 where the pixel is unknown, hidden, outside, or contradicted on the way back."""

    def matches(self) -> Matches:
        """Every pixel whose way is known, row by row."""
        height, width = self.confidence.shape
        grid = pixel_grid(height, width, self.confidence.device)
        known = self.confidence > 0
        first = grid[known].to(self.first_to_second.dtype)
        return Matches(first, first + self.first_to_second[known], self.confidence[known])


@runtime_checkable
class Matcher(Protocol):
    """Finds matches between two pictures."""

    def match(
        self,
        first: Float[Tensor, "3 h w"],
        second: Float[Tensor, "3 h2 w2"],
        first_known: Bool[Tensor, "h w"] | None = None,
    ) -> Matches:
        """Matches from `first` to `second`, colours in [0, 1]; none is an answer, too.

        `first_known` is False where `first` has a hole: no match starts there.
        """
        ...


@runtime_checkable
class SeparableMatcher(Matcher, Protocol):
    """A matcher that looks at each picture by itself first, which many pairs can share."""

    def match(
        self,
        first: Float[Tensor, "3 h w"],
        second: Float[Tensor, "3 h2 w2"],
        first_known: Bool[Tensor, "h w"] | None = None,
    ) -> Matches:
        """See `Matcher.match`; on the device of `first`."""
        matches = self.match_described(self.describe(first), self.describe(second)).to(first)
        return matches if first_known is None else matches[is_known_at(first_known, matches.first)]

    def describe(self, image: Float[Tensor, "3 h w"]) -> Any:
        """What `match_described` needs of one picture."""
        ...

    def match_described(self, first: Any, second: Any) -> Matches:
        """Matches between two pictures that `describe` has seen."""
        ...


def is_known_at(known: Bool[Tensor, "h w"], pixels: Float[Tensor, "n 2"]) -> Bool[Tensor, " n"]:
    """Whether the pixel that holds each point is known; False outside the picture."""
    height, width = known.shape
    u, v = pixels.floor().long().unbind(-1)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return inside & known[v.clamp(0, height - 1), u.clamp(0, width - 1)]


LUMA = (0.299, 0.587, 0.114)
"""Weights of the colours in a grey picture (Rec. 601)."""


def to_grey(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
    """Brightness in [0, 1]."""
    return torch.einsum("chw,c->hw", image, image.new_tensor(LUMA))


def resize(planes: Float[Tensor, "c h w"], height: int, width: int) -> Float[Tensor, "c h2 w2"]:
    """Resampled, with averaging where it shrinks."""
    shrinks = height < planes.shape[1] or width < planes.shape[2]
    return functional.interpolate(
        planes[None], (height, width), mode="bicubic", antialias=shrinks, align_corners=False
    )[0].clamp(0, 1)


def to_image_pixels(
    indices: Float[Tensor, "n 2"], working: torch.Size, size: torch.Size
) -> Float[Tensor, "n 2"]:
    """Pixels (u, v), centres at +0.5, of a picture whose shape `size` ends in height and width.

    `indices` are (column, row) in its copy of shape `working`, with centres at whole numbers, as
    libraries of networks count them.
    """
    ratio = indices.new_tensor([size[-1] / working[-1], size[-2] / working[-2]])
    return (indices + 0.5) * ratio
