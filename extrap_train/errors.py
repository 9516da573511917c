"""What a user can mend, and how a command ends: with a status, and at most one line on stderr."""

import difflib
import os
import select
import signal
import sys
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from types import FrameType


class InputError(ValueError):
    """Input from outside (file, folder, option) that cannot be used.

    The message is one line: what is wrong, where, and what to do about it. `ends_in_one_line`
    prints it after `error:`; anything else that is raised is a bug and keeps its traceback.
    """


def did_you_mean(name: str, known: Collection[str]) -> str:
    """`did you mean a, b?` with the names that look like `name`, or the first few known ones."""
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    return f"did you mean {', '.join(near)}?" if near else f"known: {', '.join(sorted(known)[:8])}"


_WRITES_ARE_LOST = 141
"""Status of a command whose reader has gone, as shells report it: 128 + SIGPIPE."""
_RESUME = "run the same command again to resume"


class Terminated(KeyboardInterrupt):
    """SIGTERM: ends a command in the way of Ctrl-C, with a status of its own."""


class Ended(SystemExit):
    """The end of a command that has said why; `code` is its status, its text what it said."""

    code: int

    def __init__(self, status: int, line: str) -> None:
        super().__init__(line)
        self.code = status


@contextmanager
def ends_in_one_line() -> Iterator[None]:
    """Turn every expected way to end early into `Ended`, and its line on stderr.

    Unusable input is `error: …` with status 1, Ctrl-C `interrupted: …` with 130, SIGTERM
    `terminated: …` with 143. A reader of the output that has gone is not an error: nothing is said.
    Anything else is a bug and keeps its traceback.
    """
    _open_closed_streams()
    with _signals_raise():
        try:
            with signals_outlive_errors():
                yield
            sys.stdout.flush()  # report a failure here, not while the interpreter exits
        except InputError as error:
            # A DataLoader raises what a worker raised with its traceback in front of the message.
            _, _, message = str(error).rpartition(f"{__name__}.InputError: ")
            raise _end(1, f"error: {message.rstrip()}") from None
        except KeyboardInterrupt as stopped:
            # After an interrupt within code from a string, as dataclasses are made of, `python -m`
            # would end by the signal; the next such code that ends takes that back.
            exec("")
            said = str(stopped) or _RESUME
            if isinstance(stopped, Terminated) or isinstance(stopped.__context__, Terminated):
                raise _end(143, f"terminated: {said}") from None
            raise _end(130, f"interrupted: {said}") from None
        except BrokenPipeError:
            if not _reader_has_gone():
                raise
            raise _end(_WRITES_ARE_LOST, "") from None
        except OSError as error:
            if not _output_fails():
                raise
            raise _end(1, f"error: standard output: {error.strerror}") from None


def _end(status: int, line: str) -> Ended:
    try:
        if line:
            print(line, file=sys.stderr, flush=True)
    except OSError:  # nobody reads it
        _drop(2)
    try:
        sys.stdout.flush()
    except OSError:
        _drop(1)
    return Ended(status, line)


def _output_fails() -> bool:
    try:
        sys.stdout.flush()
    except OSError:
        return True
    return False


def _drop(descriptor: int) -> None:
    """What is left in the stream's buffer goes nowhere when the interpreter flushes it."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)


def _reader_has_gone() -> bool:
    watched = select.poll()
    for descriptor in (1, 2):
        watched.register(descriptor, 0)
    return any(event & (select.POLLERR | select.POLLNVAL) for _, event in watched.poll(0))


def _open_closed_streams() -> None:
    """A closed stream's number would be given to the next file, which prints would go into."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115, PTH123


class _Raises:
    """A handler that raises `kind`, and remembers that it did."""

    def __init__(self, kind: type[KeyboardInterrupt]) -> None:
        self.kind = kind
        self.has_raised = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Python's hook."""
        self.has_raised = True
        raise self.kind


@contextmanager
def signals_outlive_errors() -> Iterator[None]:
    """Raise the signal that came within the block where the block ends with an error instead.

    A library may answer any exception with one of its own: an import of numba that is stopped ends
    with an ImportError, which would be a bug's traceback or the failure of one job among others.
    """
    try:
        yield
    except Exception:
        for number in (signal.SIGTERM, signal.SIGINT):
            handler = signal.getsignal(number)
            if isinstance(handler, _Raises) and handler.has_raised:
                raise handler.kind from None
        raise


@contextmanager
def _signals_raise() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers are the main thread's
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    signal.signal(signal.SIGTERM, _Raises(Terminated))
    if before[signal.SIGINT] is signal.default_int_handler:  # not where a shell ignores it
        signal.signal(signal.SIGINT, _Raises(KeyboardInterrupt))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
