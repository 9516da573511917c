"""What every part of the configuration tree needs."""

from typing import Any

from extrap_train.errors import InputError

MISSING: Any = "???"  # OmegaConf's mark for "must be given"


def dotted(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested mapping as one of dotted keys."""
    items: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            items |= dotted(value, f"{prefix}{key}.")
        else:
            items[prefix + key] = value
    return items


def require_one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    """InputError unless the option's value is one of the known words."""
    if value not in known:
        raise InputError(f"{name}={value} is unknown; known: {', '.join(known)}")
