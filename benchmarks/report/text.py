"""A table as CSV, and laid out as Markdown and as LaTeX (booktabs)."""

from collections.abc import Callable

import pandas as pd

from benchmarks.report.aggregate import Results
from benchmarks.report.table_layout import Entry, Layout, Panel
from benchmarks.run.cell_record import one_line

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
    labels = ["", "", *(row.label for row in panel.rows)]
    columns = [
        [*_two_lines(heading), *(_plain_entry(row.entries[i]) for row in panel.rows)]
        for i, heading in enumerate(panel.headings())
    ]
    blocks: list[list[list[str]]] = []
    room = 0
    for column in columns:
        wide = max(map(len, column)) + 2
        if wide > room:
            blocks.append([labels])
            room = width - max(map(len, labels))
        blocks[-1].append(column)
        room -= wide
    return "\n\n".join([f"{panel.title} (* best)", *map(_block, blocks)])


def _two_lines(heading: str) -> tuple[str, str]:
    metric, count, views = heading.rsplit(" ", 2)
    return metric, f"{count} {views}"


def _plain_entry(entry: Entry) -> str:
    return f"{'*' if entry.rank == 1 else ''}{entry.text}"


def _block(columns: list[list[str]]) -> str:
    wide = [max(map(len, column)) for column in columns]
    lines = zip(*columns, strict=True)
    return "\n".join(
        "  ".join(
            text.rjust(wide[i]) if i else text.ljust(wide[i]) for i, text in enumerate(line)
        ).rstrip()
        for line in lines
    )


def markdown(layout: Layout) -> str:
    """Every panel as a pipe table."""
    parts = [f"# {_markdown(layout.title)}\n"]
    panels = [*layout.panels[:1], *([layout.reported] if layout.reported else [])]
    panels += layout.panels[1:]
    parts += [f"## {_markdown(panel.title)}\n\n{_pipe_table(panel)}\n" for panel in panels]
    parts.append("\n\n".join(map(_markdown, layout.notes)) + "\n")
    if layout.missing:
        lines = [f"- {_markdown(line)}" for line in layout.missing]
        parts.append("Missing:\n\n" + "\n".join(lines) + "\n")
    return "\n".join(parts)


def _pipe_table(panel: Panel) -> str:
    headings = map(_markdown, panel.headings())
    lines = [["method", *headings], ["---"] * (len(panel.columns) + 1)]
    lines += [[_markdown(row.label), *map(_markdown_entry, row.entries)] for row in panel.rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _markdown(text: str) -> str:
    return "".join(_MARKDOWN_SPECIAL.get(letter, letter) for letter in text)


def _markdown_entry(entry: Entry) -> str:
    return _marked(entry, lambda text: f"**{text}**", lambda text: f"<u>{text}</u>")


def _marked(entry: Entry, best: Callable[[str], str], second: Callable[[str], str]) -> str:
    text = {1: best, 2: second}.get(entry.rank or 0, str)(entry.text)
    return text + ("°" if entry.ties_best else "")


def latex(layout: Layout) -> str:
    """Every panel as a `table*` for booktabs."""
    panels = [*layout.panels[:1], *([layout.reported] if layout.reported else [])]
    tables = [_latex_table(panel) for panel in [*panels, *layout.panels[1:]]]
    notes = "\n".join(f"% {line}" for line in [*layout.notes, *layout.missing])
    return f"% needs \\usepackage{{booktabs}}\n{notes}\n\n" + "\n\n".join(tables) + "\n"


def _latex_table(panel: Panel) -> str:
    metrics = list(dict.fromkeys(metric for metric, _ in panel.columns))
    views = list(dict.fromkeys(n for _, n in panel.columns))
    headings = panel.headings()
    spans = [
        rf"\multicolumn{{{len(views)}}}{{c}}{{{_escaped(_without_views(headings[i]))}}}"
        for i in range(0, len(headings), max(1, len(views)))
    ]
    counts = [f"{n}-view" for _ in metrics for n in views]
    body, group = [], None
    for row in panel.rows:
        if group is not None and row.group != group:
            body.append(r"\midrule")
        group = row.group
        cells = [
            _marked(
                Entry(_escaped(entry.text), entry.value, entry.rank),
                lambda text: rf"\textbf{{{text}}}",
                lambda text: rf"\underline{{{text}}}",
            )
            + ("$^\\circ$" if entry.ties_best else "")
            for entry in row.entries
        ]
        body.append(" & ".join([_escaped(row.label), *cells]) + r" \\")
    return "\n".join(
        [
            r"\begin{table*}",
            rf"\caption{{{_escaped(panel.title)}}}",
            rf"\begin{{tabular}}{{l{'c' * len(panel.columns)}}}",
            r"\toprule",
            " & ".join(["", *spans]) + r" \\",
            " & ".join(["", *counts]) + r" \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table*}",
        ]
    )


def _without_views(heading: str) -> str:
    return heading.rsplit(" ", 2)[0]


def _escaped(text: str) -> str:
    return "".join(_LATEX_SPECIAL.get(letter, letter) for letter in text)
