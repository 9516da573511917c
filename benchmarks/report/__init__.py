"""A table's reports: tidy and mean CSV, Markdown, LaTeX, plots and one self-contained page."""

from pathlib import Path

from benchmarks.catalogue import Catalogue
from benchmarks.plan import TableFolder
from benchmarks.report.layout import lay_out
from benchmarks.report.page import page
from benchmarks.report.plots import plots
from benchmarks.report.text import latex, markdown, tables
from benchmarks.results import Results
from extrap_train.store.atomic import write_atomic

FORMATS = ("csv", "md", "latex", "html")


def write_reports(
    results: Results,
    catalogue: Catalogue,
    folder: TableFolder,
    formats: tuple[str, ...] = FORMATS,
) -> list[Path]:
    """Write the reports of some formats beside the cells; returns the files, the first to read
    last.
    """
    name = results.plan["table"]["name"]
    reported = results.plan["table"]["reported"]
    layout = lay_out(results, catalogue.reported(reported) if reported else None)
    contents: dict[str, bytes] = {}
    if "csv" in formats:
        contents |= tables(results, name)
    if "md" in formats:
        contents[f"{name}.md"] = markdown(layout).encode()
    if "latex" in formats:
        contents[f"{name}.tex"] = latex(layout).encode()
    if "html" in formats:
        drawn = plots(results)
        contents |= {f"plots/{plot}.svg": svg.encode() for plot, svg in drawn.items()}
        contents["index.html"] = page(results, layout, drawn).encode()
    for file, content in contents.items():
        write_atomic(folder.path / file, content)
    return [folder.path / file for file in contents]
