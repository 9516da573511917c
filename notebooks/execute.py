"""Run every cell of notebooks without Jupyter, and keep what they print and draw.

    python notebooks/execute.py notebooks/*.ipynb

The files are rewritten with their outputs; the first error ends the run. A line that begins with
`!` is a command of the shell, as in Jupyter.
"""

import base64
import contextlib
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_COMMAND = re.compile(r"^!((?:.*\\\n)*.*)$", re.MULTILINE)
"""A command, which a backslash at its end continues on the next line."""


def execute(notebook: Path) -> None:
    """Run the cells in their order, in the current folder, and rewrite the file."""
    content = json.loads(notebook.read_text())
    names: dict[str, Any] = {"__name__": "__main__", "_shell": _shell}
    cells = [cell for cell in content["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(cells, 1):
        source = _COMMAND.sub(r"_shell(r'''\1''')", "".join(cell["source"]))
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            exec(compile(source, f"{notebook.name}, cell {number}", "exec"), names)
        cell["execution_count"], cell["outputs"] = number, _outputs(said.getvalue())
    notebook.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _shell(command: str) -> None:
    """Run a command with this interpreter's programs, and print what it prints."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path}
    run = subprocess.run(
        command, shell=True, check=True, text=True, stdout=subprocess.PIPE, env=environment
    )
    print(run.stdout, end="")


def _outputs(said: str) -> list[dict[str, Any]]:
    """What a cell printed, and the figures that it left open."""
    lines = said.splitlines(keepends=True)
    found = [{"output_type": "stream", "name": "stdout", "text": lines}] if lines else []
    for figure in map(plt.figure, plt.get_fignums()):
        picture = io.BytesIO()
        figure.savefig(picture, format="jpeg", dpi=90, bbox_inches="tight")
        data = {"image/jpeg": base64.b64encode(picture.getvalue()).decode()}
        found.append({"output_type": "display_data", "data": data, "metadata": {}})
    plt.close("all")
    return found


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        execute(Path(argument))
