"""`task=push`: a trained model on the Hugging Face hub, with a card that says what it is."""

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi

from extrap_train.config import MODEL_CONFIG, PACKAGED_MODELS, TrainConfig, packaged_names
from extrap_train.diffusion.hub import (
    FILES,
    HUB_FAILURES,
    first_line,
    is_repository,
    weights_folder,
)
from extrap_train.diffusion.leakage import record_of, trainings_of, unrecorded_models
from extrap_train.diffusion.model_files import is_own, load_model, saved_config
from extrap_train.errors import InputError
from extrap_train.runs import RunFolder, existing_run
from extrap_train.store.manifest import MANIFEST, Split, read_manifest
from extrap_train.tasks.model_card import model_card
from extrap_train.tasks.scene_model import UsedWeights
from extrap_train.terminal import terminal

_LOCAL = "local:"
"""Before the name of a start that only lies where the model was trained."""


def run(config: TrainConfig) -> None:
    """Upload the newest (or `weights`) model in one commit; a new repository is private."""
    if not config.repo:
        raise InputError("repo is not given: give repo=org/name, which the model is uploaded to")
    folder = _model_folder(config)
    steps = UsedWeights.of(replace(config, weights=_name(folder), adapter=None)).steps
    load_model(folder)  # what cannot be read is not published
    api, console = HfApi(), terminal()
    try:
        card = model_card(folder, config.repo, steps)
        place = api.create_repo(config.repo, private=True, exist_ok=True)
        files: dict[str, str | bytes] = {
            path.relative_to(folder).as_posix(): str(path) for path in _files(folder)
        }
        files |= {"README.md": card.encode(), **_records(folder)}
        added = [CommitOperationAdd(name, content) for name, content in files.items()]
        # An earlier model's files would be taken for this one's.
        removed = [
            CommitOperationDelete(name)
            for name in api.list_repo_files(config.repo)
            if name not in files and any(fnmatch(name, pattern) for pattern in FILES)
        ]
        commit = api.create_commit(
            config.repo, [*added, *removed], commit_message="Upload the model"
        )
    except HUB_FAILURES as error:
        raise InputError(
            f"repo={config.repo}: {first_line(error)}; check the name and the network, and log in "
            "with a token that may write (hf auth login)"
        ) from None
    if removed:
        console.print(f"{len(removed)} files of an earlier model are no longer there")
    console.print(f"{len(added)} files; a new repository is private until you open it there")
    console.print(f"use it: weights={config.repo}@{commit.oid}\nresult: {place}")


def _files(folder: Path) -> list[Path]:
    return sorted(path for pattern in FILES for path in folder.rglob(pattern) if path.is_file())


def _records(folder: Path) -> dict[str, bytes]:
    """The model's configuration and its run's manifest, without the places of this machine."""
    model, place = saved_config(folder), record_of(folder)
    start, name = model.start, str(folder)
    if start is not None and not _can_be_followed(start):
        model = replace(model, start=f"{_LOCAL}{Path(start).name}")
    is_lost = model.start != start  # whoever downloads it cannot follow the start
    if is_lost and name in unrecorded_models(name) and any(trainings_of(name)):
        raise InputError(
            f"weights={name}: no {MANIFEST} says what it was trained on, and it started from a "
            "model that only you have; give its run's folder, which has that file"
        )
    records: dict[str, Any] = {MODEL_CONFIG: model}
    if place is not None:
        manifest = replace(read_manifest(place), options={})
        if is_lost:
            manifest = replace(manifest, split=_all_seen(folder, manifest.split))
        records[MANIFEST] = manifest
    return {file: json.dumps(asdict(x), indent=1).encode() for file, x in records.items()}


def _can_be_followed(start: str) -> bool:
    """Whether a start's name leads as far elsewhere as it does here."""
    return start in packaged_names() or is_repository(start) or start.startswith(_LOCAL)


def _all_seen(folder: Path, split: Mapping[str, Split]) -> dict[str, Split]:
    """A run's captures with those that its starts were trained on, as far as one split a category
    can say.
    """
    seen = dict(split)
    for training in trainings_of(str(folder)):
        own = seen.setdefault(training.category, replace(training.split, test=()))
        if (own.source, own.seed) == (training.split.source, training.split.seed):
            train = tuple(sorted({*own.train, *training.split.train}))
            seen[training.category] = replace(own, train=train)
        else:
            terminal(stderr=True).print(
                f"{training.model}: its captures of {training.category} are of another source or "
                "seed and are not in the manifest; say so on the card"
            )
    return seen


def _model_folder(config: TrainConfig) -> Path:
    """Folder of the run or (packaged) model that `weights` names, by default the latest run."""
    if config.weights is None:
        return existing_run(config).model
    if config.weights in packaged_names():
        return weights_folder(config.weights, "weights")
    given = Path(config.weights)
    folder = given if is_own(given) else RunFolder(given).model
    if not is_own(folder):
        raise InputError(
            f"weights={given}: is not a model of this project; give a run's folder or its model/"
        )
    return folder


def _name(folder: Path) -> str:
    """A packaged model's name, by which its training length is looked up; else the path."""
    return folder.name if folder.parent == PACKAGED_MODELS else str(folder)
