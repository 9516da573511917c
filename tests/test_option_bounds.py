"""Every number that a user can set has a range, so that nonsense ends at the door."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from types import UnionType
from typing import get_args, get_origin, get_type_hints

import hydra
import pytest

from extrap_train.cli import register_schemas, typed_config
from extrap_train.config import TrainConfig
from extrap_train.config.checks import BOUNDS
from extrap_train.errors import InputError


def _numbers(kind: type, prefix: str = "") -> Iterator[str]:
    """Dotted names of the integers and floats in a tree of dataclasses."""
    for name, hint in get_type_hints(kind).items():
        if name not in {field.name for field in fields(kind)}:
            continue
        kinds = get_args(hint) if get_origin(hint) is UnionType else (hint,)
        for each in kinds:
            if is_dataclass(each):
                yield from _numbers(each, f"{prefix}{name}.")
            elif each in (int, float):
                yield f"{prefix}{name}"


def _options() -> list[str]:
    return sorted(_numbers(TrainConfig))


@pytest.mark.parametrize("name", _options())
def test_a_number_has_bounds(name: str) -> None:
    assert name in BOUNDS


@pytest.mark.parametrize("precision", ["bf16-true", "16-true", "64-true"])
def test_weights_stay_in_single_precision(precision: str) -> None:
    register_schemas()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        composed = hydra.compose("train", ["category=hydrant", f"trainer.precision={precision}"])
    with pytest.raises(InputError, match="known: 32-true, bf16-mixed, 16-mixed"):
        typed_config(composed)
