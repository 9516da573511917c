"""The one line with which unusable input is refused."""

from collections.abc import Callable
from pathlib import Path

import pytest

from extrap_train.errors import InputError


def complaint_of(read: Callable[..., object], *arguments: object) -> str:
    """What `read` says of its arguments: one line, which says what to do after a semicolon."""
    with pytest.raises(InputError) as caught:
        read(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    assert ";" in message
    return message


def complaint_about(read: Callable[..., object], file: Path, *arguments: object) -> str:
    """What `read` says of a file: one line, which begins with its path."""
    with pytest.raises(InputError) as caught:
        read(file, *arguments)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(file))
    return message
