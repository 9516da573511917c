"""Whether what a table says can be meant, before anything heavy loads (no torch)."""

from collections.abc import Collection, Iterable
from typing import Any

from benchmarks.catalogue import Catalogue
from benchmarks.columns import COLUMNS
from extrap_train.config import (
    CAPTURE_SOURCES,
    DRAWS,
    LPIPS_NETS,
    CapturesConfig,
    SyntheticConfig,
    TableConfig,
)
from extrap_train.config.options import check_options
from extrap_train.errors import InputError, did_you_mean

DEPTHS = ("dataset", "stereo")


def check_table(table: TableConfig, catalogue: Catalogue) -> None:
    """InputError for the first word that names nothing and the first number out of its bounds."""
    rules = table.rules
    _require_known("captures.source", [table.captures.source], CAPTURE_SOURCES)
    _require_known("rules.depth", [rules.depth], DEPTHS)
    _require_known("rules.draws", rules.draws, DRAWS)
    _require_known("draws", table.draws, rules.draws)
    _require_known("scoring.lpips", table.scoring.lpips, LPIPS_NETS)
    _require_known("scoring.lpips_weights", table.scoring.lpips_weights, LPIPS_NETS)
    _require_known("columns", table.columns, COLUMNS)
    _require_known("options", table.options, catalogue.names("method"))
    _require_known("reported", filter(None, [table.reported]), catalogue.names("reported"))
    for name in table.methods:
        catalogue.method(name)
    _require_once(table)
    check_options(table)
    _require_held_out(table.captures)
    given = table.captures.source == "reconfusion"  # its files name inputs and targets
    if rules.draws != ["given"] if given else "given" in rules.draws:
        raise InputError(
            f"rules.draws={rules.draws}: captures.source=reconfusion has draws of its own, "
            "rules.draws=[given], and nothing else has"
        )
    for n_views in rules.views:
        if n_views < 1 or (n_views >= rules.pool and not given):
            raise InputError(
                f"rules.views: {n_views} of {rules.pool} frames as inputs leave no target; give "
                "from 1 to one less than rules.pool"
            )


def lpips_weights_of(overrides: Iterable[str]) -> dict[str, str]:
    """Files by net: what verification takes of a table's options, for they lie elsewhere on every
    machine.
    """
    weights = {}
    for word in overrides:
        key, _, file = word.partition("=")
        net = key.removeprefix("scoring.lpips_weights.")
        if net == key or not file:
            raise InputError(f"{word!r}: verification takes scoring.lpips_weights.NET=FILE alone")
        _require_known("scoring.lpips_weights", [net], LPIPS_NETS)
        weights[net] = file
    return weights


def require_output_alone(overrides: Iterable[str]) -> None:
    """InputError for an option that reports cannot follow: they show a table as it was run."""
    for word in overrides:
        if word.partition("=")[0] != "output":
            raise InputError(f"{word}: a report takes output=FOLDER alone; run the table with it")


def _require_once(table: TableConfig) -> None:
    """No row, capture or draw is measured twice, or counts twice in a mean."""
    lists: dict[str, list[Any]] = {
        "methods": table.methods,
        "draws": table.draws,
        "columns": table.columns,
        "rules.views": table.rules.views,
        "rules.draws": table.rules.draws,
        "rules.seeds": table.rules.seeds,
        "captures.categories": table.captures.categories,
        "captures.scenes": table.captures.scenes,
        "quick.categories": table.quick.categories,
        "scoring.lpips": table.scoring.lpips,
    }
    for option, words in lists.items():
        twice = [word for index, word in enumerate(words) if word in words[:index]]
        if twice:
            raise InputError(f"{option}: {twice[0]} is there twice; leave one out")


def _require_held_out(captures: CapturesConfig) -> None:
    """Behind the rendered captures for testing follow those that models are trained on."""
    usual = SyntheticConfig()
    is_usual = captures.source == "synthetic" and captures.seed == usual.seed
    if is_usual and captures.sequences > usual.test_sequences:
        raise InputError(
            f"captures.sequences={captures.sequences}: models are trained on the rendered captures "
            f"behind the first {usual.test_sequences}; give fewer, or another captures.seed="
        )
    for spec in captures.scenes if captures.source == "scenes" else ():
        scheme, _, name = spec.partition(":")
        number = name.rpartition("/")[2]
        is_number = scheme == "synthetic" and number.isascii() and number.isdigit()
        if is_number and int(number) >= usual.test_sequences:
            raise InputError(
                f"captures.scenes: models are trained on {spec}; give one of the first "
                f"{usual.test_sequences}"
            )


def _require_known(option: str, words: Iterable[str], known: Collection[str]) -> None:
    for word in words:
        if word not in known:
            raise InputError(f"{option}: {word!r} is unknown; {did_you_mean(word, known)}")
