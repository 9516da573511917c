"""Weights by name: a packaged model, or a repository of the Hugging Face hub, `org/name[@rev]`.

A repository is downloaded once, as safetensors and JSON, and then found in the hub's own cache
without a network.
"""

import logging
import re
from functools import cache
from pathlib import Path
from typing import Any

from huggingface_hub import constants, hf_hub_download, snapshot_download
from huggingface_hub.errors import (
    EntryNotFoundError,
    HfHubHTTPError,
    HFValidationError,
    LocalEntryNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)

from extrap_train.config import MODEL_CONFIG, packaged_names
from extrap_train.diffusion.packaged import packaged_weights
from extrap_train.errors import InputError

FILES = ("*.safetensors", "*.json")
"""Files of a repository that are uploaded and downloaded: nothing that could run code."""
HUB_FAILURES: tuple[Any, ...] = (*HfHubHTTPError.__bases__, OSError, HFValidationError)
"""What the hub's client raises: errors of httpx or requests, by its version, and of files."""
_NAME = re.compile(
    r"(?P<repo>[a-z0-9][\w.-]*/[a-z0-9][\w.-]*)(@(?P<revision>[\w./-]+))?", re.ASCII | re.IGNORECASE
)
_WEIGHT_FILES = (".ckpt", ".safetensors", ".bin", ".pt", ".pth")


def weights_folder(name: str, option: str) -> Path:
    """Folder of a packaged model or of a repository, which is downloaded where it is not cached.

    Raises InputError where `name` is neither.
    """
    return _download(name, option) if is_repository(name) else packaged_weights(name, option)


def is_repository(name: str) -> bool:
    """Whether this can only be the name of a repository: it has one slash, and no path is so.

    Without a revision, it is a mistyped path where the part before the slash is a folder here.
    """
    found = _NAME.fullmatch(name)
    if found is None or Path(name).suffix in _WEIGHT_FILES or Path(name).exists():
        return False
    return found["revision"] is not None or not Path(name).parent.is_dir()


def pin_revision(name: str, option: str) -> str:
    """The name of a repository's commit, where its own name means another one some day; other
    names as they are.
    """
    if not is_repository(name):
        return name
    return f"{name.partition('@')[0]}@{weights_folder(name, option).name}"


@cache  # a command sees one revision of it
def _download(name: str, option: str) -> Path:
    parts = _NAME.fullmatch(name)
    assert parts is not None
    repository, revision = parts["repo"], parts["revision"]
    logging.getLogger("huggingface_hub.utils._http").setLevel(logging.ERROR)  # says every retry
    said, place = f"{option}={name}", f"{constants.ENDPOINT}/{repository}"
    try:
        # First what says that it is ours: others' models may be large.
        config = Path(hf_hub_download(repository, MODEL_CONFIG, revision=revision))
        commit = config.parent.name
        return Path(snapshot_download(repository, revision=commit, allow_patterns=list(FILES)))
    except LocalEntryNotFoundError:
        reason = f"no such path, and {place} cannot be reached nor is it in the cache of downloads"
        remedy = "check the name, the network and HF_HUB_OFFLINE"
    except EntryNotFoundError:
        reason = f"{place} holds no model of this project ({MODEL_CONFIG})"
        remedy = "give a repository that task=push wrote"
    except RevisionNotFoundError:
        reason, remedy = f"{place} has no revision {revision}", "give another @REVISION, or none"
    except RepositoryNotFoundError:
        reason = f"no such path, and no such repository at {place}, or none that you may read"
        known = ", ".join(packaged_names())
        remedy = f"check the name, log in (hf auth login), or give one of {known}"
    except HUB_FAILURES as error:
        reason, remedy = f"{place}: {first_line(error)}", "try again"
    raise InputError(f"{said}: {reason}; {remedy}")


def first_line(error: BaseException) -> str:
    """What an error says, in one line."""
    return next((line for line in map(str.strip, str(error).splitlines()) if line), repr(error))
