"""Options that cannot be meant, named in one line before anything is read or drawn."""

import math
from collections.abc import Collection

from extrap_train.errors import InputError


def check_range(
    name: str, value: int | float, least: int | float, greatest: int | float = math.inf
) -> None:
    """InputError unless `value` lies in [`least`, `greatest`]; NaN lies nowhere."""
    if not least <= value <= greatest:
        to = f"from {least:g} to {greatest:g}" if greatest < math.inf else f"at least {least:g}"
        raise InputError(f"{name}={value}: must be {to}")


def check_word(name: str, value: str, known: Collection[str]) -> None:
    """InputError unless `value` is one of the known words."""
    if value not in known:
        raise InputError(f"{name}={value} is unknown; known: {', '.join(known)}")
