"""Published schedules, scaled to the iterations that there is time for."""

import math
from dataclasses import dataclass

LEAST_BETWEEN_GROWTH = 25
"""Iterations between two changes of the number of Gaussians: fewer give no mean gradient."""
LEAST_BETWEEN_RESETS = 250
"""Iterations that opacities get to grow back."""


@dataclass(frozen=True)
class Schedule:
    """Maps iteration numbers and learning rates of `full_iterations` to `iterations`.

    Iteration numbers shrink in proportion. Learning rates (all but opacity's, which is quick
    already) grow with the square root: a step's noise then adds up to the same spread, and one that
    always points the same way goes √(full / run) times less far. Intervals keep a least length.
    """

    iterations: int
    full_iterations: int

    @property
    def rate_factor(self) -> float:
        """What learning rates are multiplied with; 1 at the full budget."""
        return math.sqrt(max(1.0, self.full_iterations / self.iterations))

    def at(self, full_iteration: int) -> int:
        """The iteration that stands where `full_iteration` stands in the published schedule."""
        return round(full_iteration * self.iterations / self.full_iterations)

    def due(self, iteration: int, first: int, interval: int, least: int) -> bool:
        """Whether something happens now that the published schedule does at `first` and every
        `interval` from there; never if that is 0, and at most every `least` iterations.
        """
        since = iteration - max(1, self.at(first))
        return interval > 0 and since >= 0 and since % max(least, self.at(interval)) == 0

    def between(self, iteration: int, full_from: float, full_until: float) -> bool:
        """Whether the iteration lies in (from, until) of the published schedule."""
        place = iteration * self.full_iterations / self.iterations
        return full_from < place < full_until


def exponential(start: float, end: float, progress: float) -> float:
    """From `start` to `end` as `progress` goes from 0 to 1, evenly in the logarithm."""
    share = min(max(progress, 0.0), 1.0)
    return math.exp((1 - share) * math.log(start) + share * math.log(end))
