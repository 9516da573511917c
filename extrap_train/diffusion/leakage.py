"""Which held-out captures a model was trained on.

`tasks/training_data.py` refuses them for training, `benchmarks/protocol/captures.py` for tables.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from extrap_train.config import MODEL_CONFIG, SyntheticConfig, packaged_names
from extrap_train.diffusion.hub import is_repository, weights_folder
from extrap_train.diffusion.model_files import is_own, saved_config
from extrap_train.store.manifest import MANIFEST, Split, read_manifest


@dataclass(frozen=True)
class TrainedCaptures:
    """The captures of one category that went into a model's training, and those held out."""

    model: str
    """Its folder, or the name of a packaged one."""
    category: str
    split: Split

    def find_leaks(self, category: str, held_out: Split) -> list[str]:
        """The captures held out of a category that this model was trained on.

        CO3D's names are unique, whatever category they are filed under; those of rendered captures
        and of one's own folders count within their category, and under another seed rendered ones
        are other objects.
        """
        seen = self.split
        is_unique = seen.source not in ("synthetic", "folders")
        same_namespace = category == self.category or is_unique
        has_seed = None not in (held_out.seed, seen.seed)
        if not same_namespace or held_out.source != seen.source:
            return []
        if has_seed and held_out.seed != seen.seed:
            return []
        return sorted({*held_out.test} & {*seen.train})


@dataclass(frozen=True)
class UnrecordedCaptures(TrainedCaptures):
    """Of a model that nothing is known of: it is taken to have seen all rendered captures that a
    training with the usual options does not hold out.
    """

    def find_leaks(self, category: str, held_out: Split) -> list[str]:
        """The captures held out that the model may have been trained on."""
        usual = SyntheticConfig()
        if held_out.source != usual.name or held_out.seed not in (None, usual.seed):
            return []
        return sorted(n for n in held_out.test if n.isdigit() and int(n) >= usual.test_sequences)


def trainings_of(weights: str | None, option: str = "model.start") -> Iterator[TrainedCaptures]:
    """What weights, as `option` names them, and those that they started from were trained on, as
    far as their runs say.

    Published weights say nothing; they were trained on other data sets.
    """
    for name, folder in _chain(weights, option):
        if (place := record_of(folder)) is not None:
            manifest = read_manifest(place, "restore it from its run")
            for category, split in manifest.split.items():
                yield TrainedCaptures(name, category, split)


def unrecorded_models(weights: str | None, option: str = "model.start") -> list[str]:
    """Of the same models those that no run says anything of, the nearest first."""
    recorded = {training.model for training in trainings_of(weights, option)}
    return [name for name, _ in _chain(weights, option) if name not in recorded]


def record_of(folder: Path) -> Path | None:
    """Where the manifest of a model's run lies: within a repository's folder, beside others."""
    places = (folder.resolve(), folder.resolve().parent)
    return next((place for place in places if (place / MANIFEST).is_file()), None)


def _chain(weights: str | None, option: str) -> Iterator[tuple[str, Path]]:
    """This project's models that weights go back to, the nearest first, with their folders."""
    known: set[str] = set()
    while weights is not None and weights not in known:
        known.add(weights)
        is_named = weights in packaged_names() or is_repository(weights)
        folder = weights_folder(weights, option) if is_named else Path(weights)
        if not is_own(folder):
            return
        yield weights, folder
        weights, option = saved_config(folder).start, f"{folder / MODEL_CONFIG}: start"
