"""A table as CSV, in plain columns, and through templates as Markdown and as LaTeX (booktabs)."""

from functools import partial
from importlib.resources import files
from typing import Any

import pandas as pd
from jinja2 import Environment

from benchmarks.report.aggregate import Results
from benchmarks.report.table_layout import Entry, Layout, heading_of
from benchmarks.run.cells import one_line

_MARKDOWN_SPECIAL = {"<": "&lt;", ">": "&gt;"} | {letter: f"\\{letter}" for letter in "\\`*|[]"}
_LATEX_SPECIAL = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "–": "--",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "°": r"$^\circ$",
    "×": r"$\times$",
    "²": r"$^2$",
}
_LATEX_DELIMITERS = {
    "variable_start_string": "<<",
    "variable_end_string": ">>",
    "block_start_string": "<%",
    "block_end_string": "%>",
}


def tables(results: Results, name: str) -> dict[str, bytes]:
    """The CSV files by name: every number, the means, and the numbers by image."""
    frames = {"": results.tidy, "_mean": results.means(), "_images": results.by_image}
    return {
        f"{name}{kind}.csv": _without_formulas(frame).to_csv(index=False).encode()
        for kind, frame in frames.items()
    }


def _without_formulas(frame: pd.DataFrame) -> pd.DataFrame:
    """No text is one that a spreadsheet would compute, or on several lines."""
    texts = [name for name in frame if not pd.api.types.is_numeric_dtype(frame[name])]
    return frame.assign(**{str(name): frame[name].map(_spreadsheet_text) for name in texts})


def _spreadsheet_text(value: object) -> object:
    if not isinstance(value, str):
        return value
    line = one_line(value)
    return f"'{line}" if line.startswith(("=", "+", "-", "@")) else line


def numbers(layout: Layout, width: int) -> str:
    """The panel over everything in plain columns, in as many blocks as the width needs."""
    panel = layout.panels[0]
    columns = [(heading_of(metric), f"{n} views") for metric, n in panel.columns]
    frame = pd.DataFrame(
        [[_plain(entry) for entry in row.entries] for row in panel.rows],
        index=[row.label for row in panel.rows],
        columns=pd.MultiIndex.from_tuples(columns) if columns else [],
    )
    return f"{panel.title} (* best)\n{frame.to_string(line_width=width)}"


def _plain(entry: Entry) -> str:
    return f"{'*' if entry.rank == 1 else ''}{entry.text}"


def markdown(layout: Layout) -> str:
    """Every panel as a pipe table."""
    return _render("table.md.jinja", layout, _MARKDOWN_SPECIAL)


def latex(layout: Layout) -> str:
    """Every panel as a `table*` for booktabs."""
    return _render("table.tex.jinja", layout, _LATEX_SPECIAL, **_LATEX_DELIMITERS)


def _render(name: str, layout: Layout, special: dict[str, str], **delimiters: Any) -> str:
    """The template with every value escaped."""
    environment = Environment(
        trim_blocks=True, lstrip_blocks=True, finalize=partial(_escape, special), **delimiters
    )
    template = environment.from_string((files("benchmarks.report") / name).read_text("utf-8"))
    return template.render(layout=layout, heading_of=heading_of)


def _escape(special: dict[str, str], value: object) -> str:
    return "".join(special.get(letter, letter) for letter in str(value))
