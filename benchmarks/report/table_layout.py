"""What a printed table shows, before it is Markdown, LaTeX or HTML."""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from benchmarks.report.aggregate import FEWEST_CAPTURES, Results
from benchmarks.run.cells import OK, one_line
from extrap_train.config import MetricConfig, metric_direction

NAMES = {
    "lpips_alex": "LPIPS (alex)",
    "lpips_vgg": "LPIPS (vgg)",
    "lpips_squeeze": "LPIPS (squeeze)",
    "dists": "DISTS",
    "masked_psnr": "mPSNR",
    "masked_ssim": "mSSIM",
    "psnr": "PSNR",
    "ssim": "SSIM",
    "unseen_psnr": "unseen PSNR",
    "unseen_ssim": "unseen SSIM",
    "compat_psnr": "MegaScenes' PSNR",
    "compat_ssim": "MegaScenes' SSIM",
    "tsed": "TSED",
    "warp_psnr": "warp PSNR",
    "accuracy_share": "accuracy",
    "completeness": "completeness",
    "f_score": "F-score",
    "accuracy_distance": "distance",
    "seconds": "time, s",
    "lpips": "LPIPS",
}
_ARROWS = {1: "↑", -1: "↓", 0: ""}
_DIGITS = {"psnr": 2, "memory_mib": 0}
_MAX_NOTE = 4000


@dataclass(frozen=True)
class Entry:
    """One number of a printed table."""

    text: str
    value: float | None
    rank: int | None = None
    """1 is the best of its column, 2 the second."""
    ties_best: bool = False
    """No worse than the best beyond chance (`benchmarks.report.aggregate`)."""
    title: str = ""
    """Interval and count, or why there is no number."""


@dataclass(frozen=True)
class Row:
    """One method."""

    label: str
    group: str
    entries: list[Entry]


@dataclass(frozen=True)
class Panel:
    """One printed table: rows over (metric, views)."""

    title: str
    columns: list[tuple[str, int]]
    """A metric's name with an arrow to its better side, and a number of views."""
    rows: list[Row]

    @property
    def metrics(self) -> list[str]:
        """Every metric once, each over all numbers of `views`."""
        return list(dict.fromkeys(metric for metric, _ in self.columns))

    @property
    def views(self) -> list[int]:
        """Every number of views once."""
        return list(dict.fromkeys(n for _, n in self.columns))

    @property
    def headings(self) -> list[str]:
        """One text per column."""
        return [f"{metric} {n} views" for metric, n in self.columns]


@dataclass(frozen=True)
class Inputs:
    """What every method was given, as its finished cells say: a table of words."""

    headings: list[str]
    rows: list[tuple[str, list[str]]]
    """A method's title, and a text for each heading."""


@dataclass(frozen=True)
class Layout:
    """Every panel, the published numbers apart, and the reasons of what is missing."""

    title: str
    panels: list[Panel]
    """By draw over everything, then by category."""
    beside: list[Panel]
    """The panels over everything of the same captures' oracle table, or of the one that is none."""
    reported: Panel | None
    inputs: Inputs
    missing: list[str]
    """Empty numbers and the cells that have none, with their reasons."""
    notes: list[str]

    def in_order(self) -> list[Panel]:
        """The panel over everything, the one beside it, the published numbers, and the rest."""
        reported = [self.reported] if self.reported else []
        return [*self.panels[:1], *self.beside, *reported, *self.panels[1:]]


def name_of(metric: str) -> str:
    """A metric as a heading."""
    return NAMES.get(metric, one_line(metric.replace("_", " ")))


def lay_out(
    results: Results, reported: dict[str, Any] | None, beside: Results | None = None
) -> Layout:
    """Arrange a table's results; `reported` is a file of published numbers, `beside` the results of
    the same captures with depth of another kind (`Results.counterpart`).

    Every text is on one line; each format escapes what means something in it.
    """
    name = _title(results)
    return Layout(
        title=name,
        panels=_panels(results, name),
        beside=_panels(beside, _title(beside))[:1] if beside else [],
        reported=None if reported is None else _list_reported(reported),
        inputs=_tabulate_inputs(results),
        missing=[one_line(line, _MAX_NOTE) for line in _missing(results)],
        notes=[one_line(line, _MAX_NOTE) for line in _notes(results)],
    )


def _title(results: Results) -> str:
    table = results.plan.table
    depth = f"depth estimated from the inputs ({table.rules.depth})"
    if table.rules.is_oracle:
        depth = "oracle: depth of the data set"
    elif results.plan.depth_from_files:
        depth = f"depth from files ({table.rules.depth}), which may know more than the inputs"
    quick = " (quick: a part of the table)" if results.plan.quick else ""
    return one_line(f"{table.title or table.name}; {depth}{quick}")


def _panels(results: Results, name: str) -> list[Panel]:
    panels = []
    categories = list(dict.fromkeys(cell.category for cell in results.cells))
    for category in [None, *(categories if len(categories) > 1 else [])]:
        means = results.means(category)
        for draw in dict.fromkeys(cell.draw for cell in results.cells):
            title = one_line(f"{category or name}, {draw} inputs")
            panels.append(_panel(title, results, means[means["draw"] == draw], category, draw))
    return panels


def _panel(
    title: str, results: Results, means: pd.DataFrame, category: str | None, draw: str
) -> Panel:
    cells = [
        cell for cell in results.cells if cell.draw == draw and category in (None, cell.category)
    ]
    views = sorted({cell.n_views for cell in cells})
    captures = len({(cell.category, cell.sequence) for cell in cells})
    columns = [(metric, n) for metric in results.plan.table.columns for n in views]
    known = {(r.method, r.metric, r.n_views): r for r in means.itertuples()}
    rows = [
        Row(
            one_line(entry.title or method),
            one_line(entry.group),
            [_entry(known.get((method, *column)), column[0]) for column in columns],
        )
        for method, entry in results.methods.items()
    ]
    counted = f"{captures} capture{'s' if captures > 1 else ''}"
    if captures < FEWEST_CAPTURES:
        counted += ": too few to tell methods apart"
    own = results.plan.table.scoring.own
    headings = [(_heading(metric, own), n) for metric, n in columns]
    return Panel(f"{title} ({counted})", headings, rows)


def _entry(mean: Any, metric: str) -> Entry:
    if mean is None:
        return Entry("–", None, title="no number: see below")
    rank = None if pd.isna(mean.rank) else int(mean.rank)
    lacking = f" ({mean.cells}/{mean.of})" if mean.cells < mean.of else ""
    return Entry(
        text=_number(mean.mean, metric) + lacking,
        value=float(mean.mean),
        rank=rank,
        ties_best=rank is not None and rank > 1 and not mean.behind_best,
        title=_spread(mean, metric),
    )


def _spread(mean: Any, metric: str) -> str:
    if mean.captures == 1:
        return f"no interval: a single capture, {mean.cells} cells"
    low, high = (_number(v, metric) for v in (mean.low, mean.high))
    return f"95 % interval {low} to {high} over {mean.captures} captures, {mean.cells} cells"


def _number(value: float, metric: str) -> str:
    if metric == "seconds":
        return f"{value:.3g}"  # a warp takes milliseconds, an optimisation minutes
    digits = next((d for suffix, d in _DIGITS.items() if metric.endswith(suffix)), 3)
    return f"{value:.{digits}f}"


def _list_reported(content: dict[str, Any]) -> Panel:
    """Published numbers, labelled as such and never ranked with ours."""
    views = sorted({n for row in content["rows"].values() for n in row})
    columns = [(metric, n) for metric in content["metrics"] for n in views]
    rows = []
    for label, by_views in content["rows"].items():
        values = {
            (metric, n): value
            for n, numbers in by_views.items()
            for metric, value in zip(content["metrics"], numbers, strict=True)
        }
        entries = [
            Entry("–", None)
            if (value := values.get(column)) is None
            else Entry(_number(value, column[0]), value)
            for column in columns
        ]
        rows.append(Row(f"{label} (reported)", "", entries))
    headings = [(_heading(metric, {}), n) for metric, n in columns]
    return Panel(f"Reported, not measured here: {content['source']}", headings, rows)


def _heading(metric: str, own: Mapping[str, MetricConfig]) -> str:
    return f"{name_of(metric)} {_ARROWS[metric_direction(metric, own)]}"


def _missing(results: Results) -> list[str]:
    """One line per reason."""
    reasons: dict[str, list[str]] = {}
    for cell in results.cells:
        if cell.status != OK:
            reasons.setdefault(cell.reason, []).append(f"{cell.method} ({cell.status})")
            continue
        for metric, score in cell.metrics.items():
            if score.value is None:
                reasons.setdefault(score.reason, []).append(name_of(metric))
    absent = len(results.plan.cells) - len(results.cells)
    lines = [
        f"{', '.join(sorted(set(where)))}: {len(where)} × {reason}"
        for reason, where in reasons.items()
    ]
    return lines + ([f"{absent} cells have not been run yet"] if absent else [])


def _notes(results: Results) -> list[str]:
    times = {entry.title: entry.time for entry in results.methods.values()}
    protocol, rules = results.plan.protocol, results.plan.table.rules
    frames = f"{rules.pool} frames by farthest-point sampling"
    if "halves" in results.plan.table.draws:
        frames += " (halves: inputs in one half of the capture, targets in the other)"
    return [
        f"Protocol {protocol[:16]}: {frames}, "
        f"{rules.image_size} × {rules.image_size} px, depth of the inputs: {rules.depth}.",
        "Masked columns are over the pixels that the warp of the inputs by this depth reaches, "
        "unseen ones over the others. With another depth these are other pixels, so compare only "
        "the other columns then.",
        "Best bold, second underlined; ° marks what cannot be told from the best (sign-flip test "
        "of the paired differences over captures, p above 5 %; below "
        f"{FEWEST_CAPTURES} captures nothing can). A mean that lacks cells says how many it has of "
        "how many, and is not ranked.",
        "Time: " + "; ".join(f"{title}: {meaning}" for title, meaning in times.items()) + ". Per "
        "image, it is generation, alignment where a row aligns its views, and the image's share of "
        "estimating depth and of adapting.",
    ]


_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def _tabulate_inputs(results: Results) -> Inputs:
    """What the finished cells say that they were given."""
    used: dict[str, dict[str, Counter[str]]] = {}
    for cell in results.cells:
        if cell.status == OK:
            for name, value in cell.given.items():
                used.setdefault(cell.method, {}).setdefault(name, Counter())[value] += 1
    headings = list(dict.fromkeys(name for words in used.values() for name in words))
    titles = {method: entry.title or method for method, entry in results.methods.items()}
    rows = [
        (
            one_line(titles[method]),
            [
                one_line(_count_values(words[name]), _MAX_NOTE) if name in words else "–"
                for name in headings
            ],
        )
        for method, words in used.items()
    ]
    return Inputs([one_line(name) for name in headings], rows)


def _count_values(values: Counter[str]) -> str:
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
