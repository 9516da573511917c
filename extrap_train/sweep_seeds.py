"""A sweep's results over its seeds: mean and standard error, and the difference to the first."""

import math
import statistics
from collections.abc import Mapping, Sequence


def over_seeds(
    first: str,
    labels: Sequence[str],
    seeds: Sequence[str],
    metrics: Mapping[str, Sequence[float]],
) -> str:
    """A Markdown table with a row a label, of jobs given by their label, seed and metrics.

    Differences are taken seed by seed to the jobs labelled `first`, so that what a seed does to all
    alike drops out, and there are none where these are missing; ± is the standard error of the mean
    over seeds, absent where there is but one.
    """
    jobs: dict[str, dict[str, int]] = {first: {}}
    for place, (label, seed) in enumerate(zip(labels, seeds, strict=True)):
        jobs.setdefault(label, {})[seed] = place
    reference = jobs[first]
    head = ["", "seeds"]
    for metric in metrics:
        head += [metric, "difference"]
    lines = [head, ["---"] * len(head)]
    for label, by_seed in jobs.items():
        line = [label, str(len(by_seed))]
        for values in metrics.values():
            decimals = _decimals(values)
            pairs = [(by_seed[seed], reference[seed]) for seed in by_seed if seed in reference]
            line.append(_spread([values[place] for place in by_seed.values()], f".{decimals}f"))
            apart = [values[one] - values[other] for one, other in pairs]
            line.append("" if by_seed is reference else _spread(apart, f"+.{decimals}f"))
        lines.append(line)
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _spread(values: Sequence[float], form: str) -> str:
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return "–"
    mean = format(statistics.fmean(known), form)
    if len(known) == 1:
        return mean
    error = statistics.stdev(known) / math.sqrt(len(known))
    return f"{mean} ± {error:{form.lstrip('+')}}"


def _decimals(values: Sequence[float]) -> int:
    """So many that the column's greatest value has four digits."""
    greatest = max((abs(value) for value in values if not math.isnan(value)), default=1.0)
    return max(0, 3 - math.floor(math.log10(greatest or 1.0)))
