"""What a command says can be taken as it stands."""

import io

import pytest
from rich.console import Console
from rich.table import Table

from extrap_train.terminal import progress, terminal, track


@pytest.mark.parametrize("path", ["x[red]y/[/]", ":smile:/a", "/long" * 60, "a b " * 60 + "c"])
def test_a_path_is_said_as_it_is(path: str, capsys: pytest.CaptureFixture[str]) -> None:
    terminal().print(f"result: {path}")
    terminal(stderr=True).print(path)
    said = capsys.readouterr()
    assert said.out == f"result: {path}\n"
    assert said.err == f"{path}\n"


def test_a_cell_of_a_table_is_no_markup_either(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("method")
    table.add_row("[red]mine[/]")
    terminal().print(table)
    assert "[red]mine[/]" in capsys.readouterr().out


def test_only_the_first_of_several_processes_speaks(capsys: pytest.CaptureFixture[str]) -> None:
    terminal(quiet=True).print("word")
    assert not capsys.readouterr().out


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The seconds that a bar believes have passed, to be set in its one place."""
    now = [0.0]
    monkeypatch.setattr("extrap_train.terminal.time.monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize("count", [7, 100, 5000])
def test_a_bar_writes_few_plain_lines_into_a_file(
    count: int, clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    for _ in track(range(count), "rendering apple", count, "sequences"):
        clock[0] += 3600.0 / count
    lines = capsys.readouterr().err.splitlines()
    assert 5 <= len(lines) <= 21
    assert all(line.startswith("rendering apple: ") for line in lines)
    assert lines[-1] == f"rendering apple: {count}/{count} sequences, in 1:00:00"
    assert "\x1b" not in "".join(lines)
    assert "\r" not in "".join(lines)


def test_a_line_tells_the_time_left_of_what_was_not_there_before(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with progress("training", 100, "steps", done=40) as bar:
        clock[0] += 20.0
        bar.reach(60, "loss 0.5")  # 20 steps in 20 s: 40 s for the others
    assert capsys.readouterr().err == "training: 60/100 steps, 0:00:40 left, loss 0.5\n"


@pytest.mark.parametrize("shown", [True, False])
def test_what_is_brief_or_hidden_writes_nothing(
    shown: bool, clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    for _ in track(range(9), "brief", 9, "views", shown=shown):
        clock[0] += 0.1 if shown else 100.0
    assert not capsys.readouterr().err


@pytest.mark.parametrize("columns", [40, 80, 120])
def test_nothing_of_a_bar_is_cut_on_a_terminal(
    columns: int, clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = io.StringIO()
    console = Console(file=screen, width=columns)
    with progress("training hydrant", 120_000, "steps") as bar:
        clock[0] += 600.0
        bar.reach(1000, "loss 0.0123, +1.23 dB against the best baseline")
        console.print(bar)
    said = " ".join(screen.getvalue().split())
    assert "training hydrant" in said
    assert "1000/120000 steps, 19:50:00 left, loss 0.0123, +1.23 dB against the best" in said
    assert "…" not in said
    assert max(map(len, screen.getvalue().splitlines())) <= columns


def test_bars_share_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    for _ in track(range(2), "outer", 2, "sequences"):
        for _ in track(range(2), "inner", 2, "pairs"):
            pass
    assert "outer" in screen.getvalue()
    assert "\x1b" in screen.getvalue()
    assert screen.getvalue().count("inner: ") == 0, "lines are for files"
