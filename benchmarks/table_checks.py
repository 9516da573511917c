"""Whether what a table says can be meant, before anything heavy loads (no torch)."""

from collections.abc import Collection, Iterable

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
    for name in table.methods:
        catalogue.method(name)
    _require_held_out(table.captures)
    given = table.captures.source == "reconfusion"  # its files name the targets
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


def _require_held_out(captures: CapturesConfig) -> None:
    """Behind the rendered captures for testing follow those that models are trained on."""
    usual = SyntheticConfig()
    is_usual = captures.source == "synthetic" and captures.seed == usual.seed
    if is_usual and captures.sequences > usual.test_sequences:
        raise InputError(
            f"captures.sequences={captures.sequences}: models are trained on the rendered captures "
            f"behind the first {usual.test_sequences}; give fewer, or another captures.seed="
        )


def _require_known(option: str, words: Iterable[str], known: Collection[str]) -> None:
    for word in words:
        if word not in known:
            raise InputError(f"{option}: {word!r} is unknown; {did_you_mean(word, known)}")
