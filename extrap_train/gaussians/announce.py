"""Saying that kernels are being compiled: otherwise the first drawing seems to hang."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from numba.core.event import Event, Listener, install_listener

_LOG = logging.getLogger(__name__)


class _Announcer(Listener):
    """Logs one line when numba compiles for the first time; loading from its cache is no event."""

    def __init__(self) -> None:
        self.silent = False

    def on_start(self, event: Event) -> None:
        if not self.silent:
            _LOG.warning(
                "compiling the CPU rasteriser (about half a minute, once on this machine; "
                "later runs load it from numba's cache)"
            )
        self.silent = True

    def on_end(self, event: Event) -> None:
        """Nothing to say."""


_ANNOUNCER = _Announcer()


@contextmanager
def announced_compilation() -> Iterator[None]:
    """Log a warning, once a process, if numba compiles anything inside."""
    with install_listener("numba:compile", _ANNOUNCER):
        yield
