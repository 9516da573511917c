"""What is asked of a saved model, which says itself what it is: where it is another, refused."""

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig

from extrap_train.config import ModelConfig, dotted
from extrap_train.errors import InputError

_OF_TRAINING = ("name", "start", "learning_rate", "projection_rate", "weight_decay")
"""Say nothing of what a trained model is."""


def require_as_said(saved: ModelConfig, asked: ModelConfig, folder: Path) -> None:
    """InputError for the first `model` option of the command line that the saved model contradicts.

    What the command line leaves out, `asked` has by default, and the saved model as it is. Of
    `model=NAME` the family must be the model's.
    """
    said = [name for name in _said() if name != "model.name"]  # names its runs' folder
    names = [n for n in _flat(asked) if any(f"{n}.".startswith(f"{option}.") for option in said)]
    _require(saved, asked, names, folder)


def require_described(saved: ModelConfig, described: ModelConfig, folder: Path) -> None:
    """InputError where a description that was given of a saved model is another's."""
    left_out = [f"model.{name}" for name in _OF_TRAINING]
    _require(saved, described, [name for name in _flat(described) if name not in left_out], folder)


def _require(saved: ModelConfig, asked: ModelConfig, names: Iterable[str], folder: Path) -> None:
    found, wanted = _flat(saved), _flat(asked)
    for name in names:
        if wanted[name] != (is_so := found.get(name)):
            remedy = "remove this option, or give weights= that were trained with it"
            if name.startswith("model.sampler."):
                remedy = f"give {name.removeprefix('model.')}= instead"
            if name == "model.image_size":
                remedy += (
                    f" (task=category {name}={asked.image_size} prep.image_size={asked.warp_size})"
                )
            raise InputError(
                f"{name}={wanted[name]}: the weights {folder} fix {name}={is_so}; {remedy}"
            )


def _said() -> list[str]:
    """Options under `model` that the command line sets, and the family where it chooses a model;
    none where no command line was read.
    """
    if not HydraConfig.initialized():
        return []
    words = HydraConfig.get().overrides.task
    names = [word.partition("=")[0].lstrip("+~") for word in words]
    said = [name for name in names if name.startswith("model.")]
    return said + (["model.family"] if "model" in names else [])


def _flat(model: ModelConfig) -> dict[str, Any]:
    return dotted({"model": asdict(model)})
