"""The pairs that a category is trained on and measured on."""

from collections.abc import Callable

from extrap_train.config import TrainConfig
from extrap_train.data.module import PairModule
from extrap_train.data.pair_examples import ExampleReader
from extrap_train.data.prepared import PreparedData
from extrap_train.errors import InputError

Prepare = Callable[[TrainConfig], list[PreparedData]]
"""Prepares every member of the category, or finds what was prepared before."""


def data_module(config: TrainConfig, prepared: list[PreparedData]) -> PairModule:
    """Training and held-out pairs; InputError where there are none of either."""
    train, validation = (
        ExampleReader(prepared, split, config.model.references) for split in ("train", "test")
    )
    for split, reader in (("training", train), ("test", validation)):
        if not len(reader):
            raise InputError(
                f"no {split} pairs for {config.category.name}: see the preparation's report, "
                f"and loosen the options under prep"
            )
    return PairModule(train, validation, config)
