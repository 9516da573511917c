"""What a command says can be taken as it stands."""

import pytest
from rich.table import Table

from extrap_train.terminal import terminal


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
