"""The one line with which unusable input is refused."""

from collections.abc import Callable

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
