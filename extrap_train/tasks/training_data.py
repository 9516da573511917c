"""The pairs that a category is trained on and measured on: no capture may be on both sides."""

from collections.abc import Callable

from extrap_train.config import TrainConfig
from extrap_train.data.examples import ExampleReader
from extrap_train.data.module import PairModule
from extrap_train.data.prepared import PreparedData
from extrap_train.diffusion.leakage import trainings_of
from extrap_train.errors import InputError
from extrap_train.store.manifest import Manifest

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


def require_unseen(start: str | None, manifest: Manifest) -> None:
    """Raise InputError if a held-out capture is one that the start (`model.start`) has seen."""
    for seen in trainings_of(start):
        for category, split in manifest.split.items():
            if not (names := seen.find_leaks(category, split)):
                continue
            through = "" if seen.model == start else f", by way of {seen.model}"
            remedy = _other_seed(seen.split.train[0]) if split.source == "synthetic" else _OTHERS
            raise InputError(
                f"model.start={start} was trained on {_listed(names)} of {category}{through}, "
                f"which this run would hold out for testing; {remedy}, or model.start=null"
            )


_OTHERS = "hold out others (data.test_sequences, data.set_list)"


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _other_seed(first_seen: str) -> str:
    """The first rendered captures are held out, and another seed renders others."""
    count = int(first_seen) if first_seen.isdigit() else 0
    fewer = f"data.test_sequences={count} or fewer, " if count else ""
    return f"give {fewer}another data.seed"
