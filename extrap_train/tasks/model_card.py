"""A model's card: what it was made from and how well it does, as its files say."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import ModelCard, ModelCardData

from extrap_train.config import packaged_names
from extrap_train.data.json_files import read_json
from extrap_train.diffusion.hub import HUB_FAILURES, is_repository
from extrap_train.diffusion.leakage import (
    TrainedCaptures,
    record_of,
    trainings_of,
    unrecorded_models,
)
from extrap_train.diffusion.model_files import is_own, saved_config
from extrap_train.runs import RunFolder
from extrap_train.store.manifest import MANIFEST, PUBLISHED, read_manifest

_OURS = "Apache-2.0"
_TAGS = ["extrap-train", "novel-view-synthesis", "diffusion"]
_OF_DATA = {
    "synthetic": "captures rendered by extrap-train",
    "co3d": "captures of CO3D (CC BY-NC 4.0)",
    "uco3d": "captures of uCO3D (CC BY 4.0)",
    "folders": "captures of the uploader's own",
    PUBLISHED: "captures that the authors of published weights chose",
}


def model_card(folder: Path, name: str, steps: int | None) -> str:
    """The card of a model's folder, to be published as `name`, as Markdown with a YAML head.

    Manifest and metrics are those of its run, where it lies in one. Its licence is only claimed
    where starting weights and data are this project's own.
    """
    model, run = saved_config(folder), RunFolder(folder.resolve().parent)
    place, trainings = record_of(folder), [*trainings_of(str(folder))]
    code = read_manifest(place).code if place else ""
    start, licence = _start(model.start)
    is_ours = licence == _OURS and not unrecorded_models(str(folder))
    is_ours &= {training.split.source for training in trainings} == {"synthetic"}
    head = ModelCardData(
        license="apache-2.0" if is_ours else "other",
        library_name="extrap-train",
        base_model=model.start if is_repository(str(model.start)) else None,
        tags=_TAGS,
    )
    rows = {
        "model": f"`{model.family}`, {model.image_size} x {model.image_size} pixels, from up to "
        f"{model.num_condition_views} references",
        "trained on": _data(trainings, str(folder)),
        "steps": "unknown" if steps is None else f"{steps:,}",
        "started from": f"{start} ({licence})",
        "code": f"extrap-train {code}".rstrip(),
    }
    own = dict.fromkeys(t.category for t in trainings if t.model == str(folder))
    categories = ", ".join(own) or "what it was trained on"
    return "\n".join(
        [
            f"---\n{head.to_yaml()}\n---\n\n# {name}\n",
            f"A diffusion model that generates views of {categories} from a few posed photos.\n",
            "```bash",
            f"python -m extrap_train task=complete category=NAME scene=FOLDER weights={name}",
            "```\n\n| | |\n|---|---|",
            *(f"| {key} | {value} |" for key, value in rows.items()),
            *(_scores(read_json(run.summary)) if run.summary.is_file() else []),
            "",
        ]
    )


def _data(trainings: Sequence[TrainedCaptures], model: str) -> str:
    """What the model was trained on, and what those before it were."""
    own = [training for training in trainings if training.model == model]
    starts = [training for training in trainings if training.model != model]
    said = "unknown"
    if own:
        held_out = sum(len(training.split.test) for training in own)
        said = f"{_captures(own)}; {held_out} held out ({MANIFEST} lists both)"
    return f"{said}; what it started from, on {_captures(starts)}" if starts else said


def _captures(trainings: Sequence[TrainedCaptures]) -> str:
    """How many there are, and where they come from."""
    seen = {(t.split.source, t.split.seed, t.category, n) for t in trainings for n in t.split.train}
    sources = sorted({_OF_DATA.get(t.split.source, t.split.source) for t in trainings})
    return f"{len(seen) or 'unknown'} {' and '.join(sources)}"


def _start(start: str | None) -> tuple[str, str]:
    """What a chain of starts goes back to, and its licence."""
    before = ""
    while start is not None and start not in packaged_names() and is_own(Path(start)):
        start = saved_config(Path(start)).start
        before = "an earlier model, which started from "
    if start is None:
        return f"{before}random weights", _OURS
    if start in packaged_names():
        return f"{before}`{start}` of extrap-train", _OURS
    if is_repository(start):
        return f"{before}{start}", _licence_of(start)
    return f"{before}`{Path(start).name}`", "its authors' licence"


def _licence_of(repository: str) -> str:
    name, _, _ = repository.partition("@")
    try:
        said = ModelCard.load(name).data.license
    except (*HUB_FAILURES, ValueError, TypeError, yaml.YAMLError):  # no card, or a broken one
        said = None
    return {"apache-2.0": _OURS}.get(str(said), str(said or "the licence that its page names"))


def _scores(summary: Mapping[str, Any]) -> list[str]:
    """The held-out views' mean scores, as the run's summary has them."""
    validation = summary.get("validation")
    if not isinstance(validation, dict) or not validation.get("model"):
        return []
    metrics = list(validation["model"])
    lines = [
        "\nHeld-out views:\n",
        f"| | {' | '.join(metrics)} |",
        "|---" * (len(metrics) + 1) + "|",
    ]
    for method, row in validation.items():
        numbers = ["–" if row.get(m) is None else f"{row[m]:.4g}" for m in metrics]
        lines.append(f"| {method} | {' | '.join(numbers)} |")
    return lines
