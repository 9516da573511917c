"""Category diffusion models that complete 3D scenes from a few posed photos.

What is imported from here stays: `from extrap_train import open_scene`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from extrap_train.data.scene import open_scene

__all__ = ["open_scene"]

_HOMES = {"open_scene": "extrap_train.data.scene"}
"""Where each name is defined: it is imported when it is asked for, so that `--help` stays fast."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
