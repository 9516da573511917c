"""What a model has seen before its training begins: none of it may be what it is measured on."""

from collections.abc import Iterator
from pathlib import Path

from extrap_train.diffusion.checkpoint import is_own, saved_config
from extrap_train.diffusion.packaged import packaged_names, packaged_weights
from extrap_train.errors import InputError
from extrap_train.trained_on import TRAINED_ON, TrainedOn


def require_unseen(start: str | None, trained_on: TrainedOn) -> None:
    """InputError where something is held out that the start (`model.start`) was trained on."""
    for model, seen in seen_before(start):
        for category, data in trained_on.categories.items():
            before = seen.categories.get(category)
            if before is None or not (names := data.seen_by(before)):
                continue
            through = "" if model == start else f", by way of {model}"
            raise InputError(
                f"model.start={start} was trained on {_listed(names)} of {category}{through}, "
                f"which are to be held out: {_remedy(data.source, before.train)}, or "
                "model.start=null"
            )


def seen_before(start: str | None) -> Iterator[tuple[str, TrainedOn]]:
    """Each model that the start goes back to, and what it was trained on, as far as they say so.

    Published weights do not; they were trained on other data sets.
    """
    known: set[str] = set()
    while start is not None and start not in known:
        known.add(start)
        folder = Path(start)
        if not folder.exists() and start in packaged_names():
            folder = packaged_weights(start)
        if not is_own(folder):
            return
        if (record := folder.resolve().parent / TRAINED_ON).is_file():
            yield start, TrainedOn.read(record)
        start = saved_config(folder).start


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _remedy(source: str, seen: tuple[str, ...]) -> str:
    """Of rendered captures the first are held out, and another seed makes others."""
    if source != "synthetic":
        return "hold out others (data.test_sequences, data.set_list)"
    fewer = f"data.test_sequences={first} or fewer, " if (first := int(min(seen))) else ""
    return f"give {fewer}another data.seed"
