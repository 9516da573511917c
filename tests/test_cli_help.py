"""Help, version and completion: what a command says of itself before it does anything."""

import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest

from data_prep.__main__ import main as prepare
from extrap_train.__main__ import main
from extrap_train.cli import PREP, TRAIN
from extrap_train.command_line import CommandOptions, choices_of

Said = Callable[..., str]
_COMMANDS = pytest.mark.parametrize(("command", "options"), [(main, TRAIN), (prepare, PREP)])


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Said:
    """What a command prints when it is given some words."""

    def run(command: Callable[[], None], *words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["it", *words])
        command()
        return capsys.readouterr().out

    return run


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("category=hy", ["category=hydrant"]),
        ("depth=", ["dataset", "files", "mast3r", "monocular"]),
    ],
)
def test_the_shell_completes_choices_and_no_schemas(
    typed: str, offered: list[str], monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    monkeypatch.setenv("COMP_LINE", f"extrap_train {typed}")
    monkeypatch.setenv("COMP_POINT", str(len(f"extrap_train {typed}")))
    words = said(main, "-sc", "query=bash").split()
    assert all(any(choice in word for word in words) for choice in offered)
    assert not [word for word in words if "_schema" in word]


@_COMMANDS
def test_help_has_a_line_for_every_option_with_its_default(
    command: Callable[[], None], options: CommandOptions, said: Said
) -> None:
    lines = said(command, "trainer.steps=77", "--help").splitlines()
    for option in options.by_name.values():
        own = [line for line in lines if line.strip().startswith(f"{option.name}=")]
        if option.declared.help and not option.name.startswith("depth.matcher."):
            assert own, option.name
            assert any(option.declared.help in line for line in own)
            assert any(option.range in line and option.declared.unit in line for line in own)
    assert "  prep.image_size=128" in "\n".join(lines)


def test_help_tells_what_each_task_does(said: Said) -> None:
    lines = said(main, "--help").splitlines()
    for task, meaning in TRAIN.tasks.items():
        assert [line.split(None, 1) for line in lines if line.split()[:1] == [task]] == [
            [task, meaning]
        ]


@_COMMANDS
def test_help_lists_the_choices_with_those_of_ones_own(
    command: Callable[[], None], options: CommandOptions, said: Said, tmp_path: Path
) -> None:
    own = tmp_path / "my choices/category/vase.yaml"
    own.parent.mkdir(parents=True)
    own.touch()
    text = said(command, "--config-dir", str(own.parents[1]), "--help")
    assert " | ".join(sorted([*choices_of("category"), "vase"])) + "\n" in text
    assert " | ".join(choices_of("depth")) in text
    groups = {line.split("=")[0].strip() for line in text.splitlines() if "= " in line}
    assert {*options.groups, *options.file_groups} <= groups
    assert "_schema" not in text


@pytest.mark.parametrize("command", [main, prepare])
def test_version_is_the_projects(command: Callable[[], None], said: Said) -> None:
    assert said(command, "--version") == f"extrap-train {version('extrap-train')}\n"


@pytest.mark.parametrize("module", ["extrap_train", "data_prep", "benchmarks"])
def test_help_needs_no_torch(module: str) -> None:
    """`--help` must be instant: it may not import the libraries that take seconds."""
    code = (
        "import runpy, sys; sys.argv = ['x', '--help']\n"
        f"try: runpy.run_module('{module}', run_name='__main__')\n"
        "except SystemExit: pass\n"
        "print('HEAVY' if 'torch' in sys.modules else 'LIGHT')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.rstrip().endswith("LIGHT"), result.stdout + result.stderr
    assert "usage" in result.stdout.lower()
