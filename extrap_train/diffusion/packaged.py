"""The small models that come with the package, by name."""

import json
from pathlib import Path

from extrap_train.errors import InputError

MODEL_CONFIG = "extrapolation_model.json"
"""What makes a folder a model of this project: its configuration."""
_FOLDER = Path(__file__).parents[1] / "weights"


def packaged_weights(name: str, option: str = "model.start") -> Path:
    """Folder of a model that comes with the package; InputError names those that do."""
    if name not in packaged_names():
        raise InputError(
            f"{option}={name} is neither a file or folder of weights nor one of the package's: "
            f"{', '.join(packaged_names())}"
        )
    return _FOLDER / name


def packaged_names() -> list[str]:
    """All models of the package."""
    return sorted(path.parent.name for path in _FOLDER.glob(f"*/{MODEL_CONFIG}"))


def packaged_steps(name: str) -> int | None:
    """How many steps a packaged model was trained for; None if that is not recorded."""
    steps: dict[str, int] = json.loads((_FOLDER / "steps.json").read_bytes())
    return steps.get(name)


def packaged_name(family: str, category: str) -> str:
    """`ours-hydrant`; the published families are of no category: `zeronvs`, `megascenes`."""
    return f"{family}-{category}" if family == "ours" else family
