"""Help and completion: what a command says of itself before it does anything."""

import subprocess
import sys

import pytest

from extrap_train.__main__ import main


def test_the_shell_completes_choices(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COMP_LINE", "extrap_train category=hy")
    monkeypatch.setenv("COMP_POINT", "24")
    monkeypatch.setattr(sys, "argv", ["extrap_train", "-sc", "query=bash"])
    main()
    assert capsys.readouterr().out.split() == ["category=hydrant"]


def test_help_takes_options_before_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["extrap_train", "trainer.steps=77", "--help"])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert not stopped.value.code
    assert "steps: 77" in capsys.readouterr().out


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
