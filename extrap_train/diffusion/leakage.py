"""Which held-out captures a model was trained on.

`tasks/training_data.py` refuses them for training, `benchmarks/protocol/captures.py` for tables.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from extrap_train.config import packaged_names
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
        count within their category, and under another seed are other objects.
        """
        seen = self.split
        same_namespace = category == self.category or seen.source != "synthetic"
        has_seed = None not in (held_out.seed, seen.seed)
        if not same_namespace or held_out.source != seen.source:
            return []
        if has_seed and held_out.seed != seen.seed:
            return []
        return sorted({*held_out.test} & {*seen.train})


def trainings_of(weights: str | None) -> Iterator[TrainedCaptures]:
    """What weights and those that they started from were trained on, as far as their runs say.

    The manifest lies beside the model's folder, or within that of a repository. Published weights
    have none; they were trained on other data sets.
    """
    known: set[str] = set()
    while weights is not None and weights not in known:
        known.add(weights)
        is_named = weights in packaged_names() or is_repository(weights)
        folder = weights_folder(weights, "model.start") if is_named else Path(weights)
        if not is_own(folder):
            return
        places = (folder.resolve(), folder.resolve().parent)
        for place in [place for place in places if (place / MANIFEST).is_file()][:1]:
            manifest = read_manifest(place, "restore it from its run")
            for category, split in manifest.split.items():
                yield TrainedCaptures(weights, category, split)
        weights = saved_config(folder).start
