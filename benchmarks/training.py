"""What the trained models of a table have seen: no capture of it may be a test capture."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from data_prep.split import by_hash
from extrap_train.config import MethodConfig
from extrap_train.data.sequences import FrameSequence
from extrap_train.errors import InputError
from extrap_train.store.cache import read_manifest
from extrap_train.store.manifest import MANIFEST, Split


@dataclass(frozen=True)
class TrainedModel:
    """A method's model, where its run says what it was trained on."""

    method: str
    run: Path
    category: str
    data: Split

    def require_unseen(self, captures: Iterable[FrameSequence]) -> None:
        """InputError for the first capture that the model was trained on.

        By name alone: those of CO3D are unique, whatever a table calls their category.
        """
        seen = next((c.name for c in captures if c.name in self.data.train), None)
        if seen is not None:
            raise InputError(
                f"options.{self.method}.weights: {self.run} was trained on the capture {seen}; "
                "test on others, or give weights that have not seen it"
            )


def trained_models(
    methods: Iterable[MethodConfig], categories: Collection[str]
) -> list[TrainedModel]:
    """The models of CO3D captures among the methods' `weights` that lie in their runs.

    What rendered captures models may be tested on is for `table_checks` to say.
    """
    found = []
    for method in methods:
        weights = method.options.get("weights")
        if not isinstance(weights, str):
            continue
        for folder in sorted({weights.replace("{category}", c) for c in categories or [""]}):
            run = Path(folder).resolve().parent
            if not (run / MANIFEST).is_file():
                continue
            found += [
                TrainedModel(method.name, run, category, data)
                for category, data in read_manifest(run, "restore it").split.items()
                if data.source == "co3d"
            ]
    return found


def held_out_by_all(
    models: Iterable[TrainedModel], category: str, present: Collection[str], count: int
) -> list[str] | None:
    """Up to `count` test captures of a category, by name; None where no model says which.

    Those that every model of the category holds out, in the order in which a split takes them.
    Raises InputError where there are none.
    """
    models = [model for model in models if model.category == category]
    if not models:
        return None
    common = set(present).intersection(*(model.data.test for model in models))
    if not common:
        runs = " and ".join(sorted({str(model.run) for model in models}))
        raise InputError(
            f"{category}: none of the {len(present)} captures is held out by {runs}; test on "
            "other captures, or train with more data.test_sequences"
        )
    return sorted(sorted(common, key=lambda name: by_hash(f"{category}/{name}"))[:count])
