"""What each method used, for the reader who wants to know whether the race was fair."""

import re
from collections import Counter

from benchmarks.report.aggregate import Results
from benchmarks.run.cell_record import OK

_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def input_notes(results: Results) -> list[str]:
    """One line of what the finished cells say that they were given, or none."""
    used: dict[str, dict[str, Counter[str]]] = {}
    for cell in results.cells:
        if cell.status == OK:
            for name, value in cell.given.items():
                used.setdefault(cell.method, {}).setdefault(name, Counter())[value] += 1
    lines = [
        f"{method} — {', '.join(f'{name}: {_counted(values)}' for name, values in words.items())}"
        for method, words in used.items()
    ]
    return ["Inputs: " + "; ".join(lines) + "."] if lines else []


def _counted(values: Counter[str]) -> str:
    """With the number of cells where they are not all alike; words that differ in their numbers
    only are said once, with the numbers' ranges.
    """
    alike: dict[str, Counter[str]] = {}
    for value, count in values.items():
        alike.setdefault(_NUMBER.sub("#", value), Counter())[value] = count
    if len(alike) == 1:
        return _with_ranges(next(iter(alike.values())))
    return " / ".join(
        f"{_with_ranges(alike[words])} ({alike[words].total()} cells)" for words in sorted(alike)
    )


def _with_ranges(values: Counter[str]) -> str:
    """One text for several that differ in their numbers: `12 to 152 points`."""
    first, *_ = values
    columns = zip(*(_NUMBER.findall(value) for value in values), strict=True)
    spans = iter([(min(column, key=float), max(column, key=float)) for column in columns])

    def span(_: re.Match[str]) -> str:
        low, high = next(spans)
        return low if low == high else f"{low} to {high}"

    return _NUMBER.sub(span, first)
