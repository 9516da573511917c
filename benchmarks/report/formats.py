"""A table as CSV, in plain columns, and through templates as Markdown, as LaTeX (booktabs), and as
one HTML page that needs nothing else: tables, plots, and every image with truth and error.
"""

import base64
import io
import json
import math
from functools import partial
from importlib.resources import files
from typing import Any

import pandas as pd
from jaxtyping import Float
from jinja2 import Environment, Template
from PIL import Image
from torch import Tensor

from benchmarks.protocol.array_files import pictures_of, read_limited
from benchmarks.protocol.prepared_scene import Scene
from benchmarks.report.aggregate import Results
from benchmarks.report.table_layout import Entry, Layout, Panel, name_of
from benchmarks.run.cells import OK, Cell, one_line
from extrap_train.data.image_files import to_eight_bits
from extrap_train.errors import InputError
from extrap_train.figures import error_map

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
    """The panels over everything in plain columns, in as many blocks as the width needs."""
    return "\n\n".join(_numbers(panel, width) for panel in [*layout.panels[:1], *layout.beside])


def _numbers(panel: Panel, width: int) -> str:
    columns = [(metric, f"{n} views") for metric, n in panel.columns]
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
    return _template(name, finalize=partial(_escape, special), **delimiters).render(layout=layout)


def _template(name: str, **options: Any) -> Template:
    environment = Environment(trim_blocks=True, lstrip_blocks=True, **options)
    return environment.from_string((files("benchmarks.report") / name).read_text("utf-8"))


def _escape(special: dict[str, str], value: object) -> str:
    return "".join(special.get(letter, letter) for letter in str(value))


_LARGE_PIXELS = 160
"""From here on pictures are embedded as JPEG: the page stays below some tens of megabytes."""


def page(results: Results, layout: Layout, plots: dict[str, str]) -> str:
    """The page as text."""
    # No "</script" or "<!--" may stand in the element that holds the data.
    data = json.dumps(_scenes(results)).replace("<", "\\u003c")
    return _template("page.html", autoescape=True).render(
        layout=layout, plots=plots, data=data, title=layout.title, count=len(results.cells)
    )


def _scenes(results: Results) -> list[dict[str, Any]]:
    """Every prepared draw with its inputs, truths, and each method's images, errors and scores."""
    by_scene: dict[str, list[Cell]] = {}
    for cell in results.cells:
        by_scene.setdefault(cell.scene, []).append(cell)
    return [_scene(results, name, cells) for name, cells in by_scene.items()]


def _scene(results: Results, name: str, cells: list[Cell]) -> dict[str, Any]:
    scene = Scene.open(results.folder.scenes / name)
    truth = scene.truth()
    return {
        "name": name,
        "inputs": [_embed_picture(view.image) for view in scene.inputs().views],
        "targets": list(scene.draw.targets),
        "angles": [round(math.degrees(angle)) for angle in scene.record.angles_rad],
        "truth": [_embed_picture(image) for image in truth.images],
        "warp": [_embed_picture(image) for image in truth.warps],
        "methods": [_method(results, cell, scene, truth.images) for cell in cells],
    }


def _method(
    results: Results, cell: Cell, scene: Scene, truth: Float[Tensor, "n 3 h w"]
) -> dict[str, Any]:
    title = one_line(results.methods[cell.method].title or cell.method)
    if cell.status != OK:
        return {"title": title, "status": cell.status, "reason": one_line(cell.reason)}
    files = [results.folder.cells / cell.key / name for name in cell.images]
    if len(files) != len(truth):
        raise InputError(f"{files[0].parent}: has another number of images than of targets")
    side = scene.record.image_size
    images = pictures_of({file: read_limited(file) for file in files}, side)
    shown = ("masked_psnr", "lpips_squeeze", "lpips_alex")
    return {
        "title": title,
        "status": OK,
        "images": [_embed_picture(image) for image in images],
        "errors": [_embed_picture(image) for image in error_map(images, truth)],
        "scores": {
            name_of(m): cell.metrics[m].per_image
            for m in shown
            if m in cell.metrics and cell.metrics[m].per_image
        },
    }


def _embed_picture(image: Float[Tensor, "3 h w"]) -> str:
    picture = Image.fromarray(to_eight_bits(image.permute(1, 2, 0)))
    content = io.BytesIO()
    kind = "jpeg" if picture.width >= _LARGE_PIXELS else "png"
    picture.save(content, kind, quality=90)
    return f"data:image/{kind};base64,{base64.b64encode(content.getvalue()).decode()}"
