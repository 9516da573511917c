"""The random numbers of training steps, the same however many processes share a step."""

import zlib
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor


class StepNoise:
    """The random numbers of one training step, of which a process takes those of its examples.

    All processes draw the numbers of the whole batch, in which process `rank` of `world` has the
    `rank`-th part. So they take the step that one process takes with the whole batch. Numbers are
    drawn on the CPU.
    """

    def __init__(self, generator: torch.Generator, rank: int = 0, world: int = 1) -> None:
        self._generator, self._rank, self._world = generator, rank, world

    def normal(self, shape: Sequence[int]) -> Float[Tensor, "b ..."]:
        """Standard normal numbers; the first length is the process's number of examples."""
        count, *rest = shape
        return self._own(torch.randn(count * self._world, *rest, generator=self._generator))

    def uniform(self, count: int) -> Float[Tensor, " b"]:
        """A number in [0, 1) for each example."""
        return self._own(torch.rand(count * self._world, generator=self._generator))

    def integers(self, end: int, count: int) -> Int[Tensor, " b"]:
        """A whole number from 0 to `end` − 1 for each example."""
        return self._own(torch.randint(0, end, (count * self._world,), generator=self._generator))

    def _own(self, drawn: Tensor) -> Tensor:
        return drawn.chunk(self._world)[self._rank]


def noise_of_step(seed: int, step: int, rank: int = 0, world: int = 1) -> StepNoise:
    """The numbers of one step of a run.

    torch's CPU generator takes 32 bits of a seed: where there are more (from seed 64 on), all of
    them are hashed into 32, so that no two steps of a run are the same.
    """
    number = (seed * 2**20 + step) * 64
    if number >= 2**32:
        number = zlib.crc32(number.to_bytes(12, "little"))
    return StepNoise(torch.Generator().manual_seed(number), rank, world)
