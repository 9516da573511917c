"""What commands print: text as it is, and progress bars."""

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

T = TypeVar("T")

DRAWN_EVERY_S = 0.25
"""Least seconds between two drawings of a bar on a terminal."""
LINE_EVERY_S = 10.0
"""A bar writes at most one line in this time where the output is not a terminal."""
LINE_EVERY_SHARE = 0.05
"""The least share of a bar between two of its lines."""
_BRIEF_S = 2.0
"""What ended sooner leaves no line."""
_BAR_COLUMNS = 24


def terminal(*, stderr: bool = False, quiet: bool = False) -> Console:
    """A console that says text as it is: what stands in brackets is not markup, nothing between
    colons a picture, and a line is not folded, so that a path can be taken from it.
    """
    return _Console(stderr=stderr, quiet=quiet, markup=False, emoji=False, soft_wrap=True)


class _Console(Console):
    def on_broken_pipe(self) -> None:
        raise BrokenPipeError  # every command ends alike on it


class Bar:
    """How far one piece of work is; see `progress`."""

    def __init__(self, label: str, total: int, unit: str, done: int) -> None:
        self.label, self.total, self.unit, self.done = label, total, unit, done
        self.note = ""
        self._started, self._first = time.monotonic(), done
        self._told_at, self._told = self._started, done

    def advance(self, count: int = 1, note: str | None = None) -> None:
        """`count` more are done."""
        self.reach(self.done + count, note)

    def reach(self, done: int, note: str | None = None) -> None:
        """`done` are done altogether; `note` stays until another one is given."""
        self.done = done
        self.note = self.note if note is None else note
        waited = time.monotonic() - self._told_at >= LINE_EVERY_S
        if waited and done - self._told >= LINE_EVERY_SHARE * self.total:
            self._print_line()

    def close(self) -> None:
        """Write the last line."""
        if time.monotonic() - self._started >= _BRIEF_S and self.done > self._told:
            self._print_line()

    def _print_line(self) -> None:
        self._told_at, self._told = time.monotonic(), self.done
        if self in _OPEN and not _LIVE:
            terminal(stderr=True).print(f"{self.label}: {self.state}")

    @property
    def state(self) -> str:
        """How much of it is done, and how long the rest will take."""
        elapsed = time.monotonic() - self._started
        parts = [f"{self.done}/{self.total} {self.unit}"]
        if self.done >= self.total:
            parts.append(f"in {_clock(elapsed)}")
        elif self.done > self._first:
            rest = elapsed / (self.done - self._first) * (self.total - self.done)
            parts.append(f"{_clock(rest)} left")
        return ", ".join([*parts, *filter(None, [self.note])])

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The label, the bar and how it stands; a second line where one would be cut."""
        state = self.state
        room = options.max_width - len(self.label) - len(state) - 2
        bar = ProgressBar(self.total, self.done, width=max(4, min(_BAR_COLUMNS, room)))
        line = Table.grid(padding=(0, 1))
        if room >= 4:
            line.add_row(Text(self.label), bar, Text(state))
            yield line
        else:
            line.add_row(Text(self.label), bar)
            yield line
            yield Text(f"  {state}")


_OPEN: list[Bar] = []
_LIVE: list[Live] = []
"""The display of all open bars, where the output is a terminal."""


@contextmanager
def progress(
    label: str, total: int, unit: str, *, done: int = 0, shown: bool = True
) -> Iterator[Bar]:
    """A labelled bar on stderr with the time that is left, of which `done` is there already.

    On a terminal it is drawn again and again; elsewhere a plain line is written now and then. Bars
    may be nested. What is printed meanwhile stands above them.
    """
    bar = Bar(label, total, unit, done)
    if not shown or done >= total:
        yield bar
        return
    console = Console(stderr=True, markup=False, emoji=False)
    opens_display = console.is_terminal and not console.is_dumb_terminal and not _LIVE
    _OPEN.append(bar)
    if opens_display:
        live = Live(
            console=console,
            get_renderable=lambda: Group(*_OPEN),
            refresh_per_second=1 / DRAWN_EVERY_S,
        )
        live.start()
        _LIVE.append(live)
    try:
        yield bar
    finally:
        bar.close()
        if opens_display:
            _LIVE.pop().stop()
        _OPEN.remove(bar)


def open_bars() -> tuple[Bar, ...]:
    """The bars of what is being done at the moment, outermost first."""
    return tuple(_OPEN)


def track(
    items: Iterable[T], label: str, total: int, unit: str, *, shown: bool = True
) -> Iterator[T]:
    """The items, with a bar that advances by each one; see `progress`."""
    with progress(label, total, unit, shown=shown) as bar:
        for item in items:
            yield item
            bar.advance()


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
