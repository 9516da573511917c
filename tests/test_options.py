"""Every option says what it means and which values it takes, and its range is kept."""

import math
from dataclasses import dataclass

import hydra
import pytest

from extrap_train.cli import PREP, TRAIN, register_schemas, typed_config
from extrap_train.config import Option, TableConfig, check_options, options_of
from extrap_train.config.options import option
from extrap_train.errors import InputError


def _all_options() -> list[Option]:
    trees = [TRAIN.by_name, PREP.by_name, options_of(TableConfig)]
    named = {name: found for tree in trees for name, found in tree.items()}
    return [found for name, found in named.items() if not name.endswith(".name")]


def test_every_option_says_what_it_means() -> None:
    assert [found.name for found in _all_options() if not found.declared.help] == []
    long = [f.name for f in _all_options() if len(f.declared.help) > 160 or "\n" in f.declared.help]
    assert long == []


def test_every_number_has_a_range_that_its_default_lies_in() -> None:
    numbers = [found for found in _all_options() if found.kind in (int, float)]
    assert len(numbers) > 60
    assert [found.name for found in numbers if not found.range] == []
    for found in numbers:
        found.check([] if found.default is None else found.default)


def test_every_number_out_of_its_range_is_refused_by_name() -> None:
    for found in _all_options():
        ends = (found.declared.low - 1, found.declared.high + 1)
        for wrong in (end for end in ends if math.isfinite(end) and found.kind in (int, float)):
            for value in (wrong, [wrong]) if found.is_list else (wrong,):
                with pytest.raises(InputError, match=rf"^{found.name}="):
                    found.check(value)
        if found.kind is float:
            with pytest.raises(InputError, match=rf"^{found.name}="):
                found.check(math.nan)


def test_every_word_that_is_not_known_is_refused_by_name() -> None:
    words = [found for found in _all_options() if found.declared.choices]
    assert len(words) > 10
    for found in words:
        found.check([] if found.default is None else found.default)
        with pytest.raises(InputError, match=rf"^{found.name}=nonsense"):
            found.check("nonsense")


def test_values_below_the_top_are_checked_too() -> None:
    @dataclass
    class Inner:
        share: float = option(0.5, "a share", low=0, high=1)

    @dataclass
    class Outer:
        inner: Inner

    check_options(Outer(Inner(1.0)))
    with pytest.raises(InputError, match=r"^inner.share=1.5"):
        check_options(Outer(Inner(1.5)))


@pytest.mark.parametrize("precision", ["bf16-true", "16-true", "64-true"])
def test_weights_stay_in_single_precision(precision: str) -> None:
    register_schemas()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        composed = hydra.compose("train", ["category=hydrant", f"trainer.precision={precision}"])
    with pytest.raises(InputError, match="known: auto, 32-true, bf16-mixed, 16-mixed"):
        typed_config(composed)
