"""A table's reports: tidy and mean CSV, Markdown, LaTeX, plots and one self-contained page."""

import logging
from pathlib import Path

from benchmarks.catalogue import Catalogue
from benchmarks.report.aggregate import Results
from benchmarks.report.formats import latex, markdown, numbers, page, tables
from benchmarks.report.plots import plots
from benchmarks.report.table_layout import Layout, lay_out
from benchmarks.run.plan import TableFolder
from extrap_train.errors import InputError
from extrap_train.store.atomic import write_atomic

__all__ = ["lay_out_results", "numbers", "write_reports"]

LOG = logging.getLogger(__name__)
FORMATS = ("csv", "md", "latex", "html")


def lay_out_results(results: Results, catalogue: Catalogue) -> Layout:
    """A table's results, arranged, with the published numbers that it names and, where there are
    results of both, the oracle table beside the one with estimated depth.
    """
    reported = results.plan.table.reported
    content = catalogue.content("reported", reported) if reported else None
    beside = None
    try:
        beside = results.counterpart()
    except InputError as error:
        LOG.warning("%s (not shown beside)", error)
    return lay_out(results, content, beside)


def write_reports(
    results: Results, layout: Layout, folder: TableFolder, formats: tuple[str, ...] = FORMATS
) -> list[Path]:
    """Write the reports of some formats to the table's folder; returns the files, the first to read
    last.
    """
    name = results.plan.table.name
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
