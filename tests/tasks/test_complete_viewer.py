"""`task=complete` with its viewer: the results are there before anybody has looked at the page."""

import sys
from pathlib import Path

import pytest

from extrap_train.__main__ import main
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.reconstruction.viewer import CloudViewer
from extrap_train.tasks import complete

_TINY = [
    "task=complete",
    "category=cup",
    "scene=synthetic:cup/0000",
    "data.image_size=32",
    "inputs=3",
    "complete.generator=exact",
    "complete.exact_size=24",
    "complete.step_deg=150",
    "complete.splats.fit=false",
    "complete.viewer=true",
    "threads=1",
]


class _Page(CloudViewer):
    """A viewer without a server."""

    url = ""
    closed = False

    def __init__(self, port: int, votes: bool, host: str) -> None:
        pass

    def show(self, known: GlobalMap) -> None:
        pass

    def close(self) -> None:
        _Page.closed = True


def test_results_are_written_before_anybody_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    summary = tmp_path / "complete" / "cup_0000" / "summary.json"
    there_when_asked = []

    def press_enter(prompt: str) -> str:
        assert not _Page.closed
        there_when_asked.append(summary.is_file())
        return ""

    monkeypatch.setattr(complete, "CloudViewer", _Page)
    monkeypatch.setattr("builtins.input", press_enter)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys, "argv", ["extrap_train", *_TINY, f"output={tmp_path}"])
    main()
    assert there_when_asked == [True]
    assert _Page.closed
