"""One HTML page that needs nothing else: tables, plots, and every image with truth and error."""

import base64
import io
import json
import math
from importlib.resources import files
from typing import Any

from jaxtyping import Float
from jinja2 import Environment
from PIL import Image
from torch import Tensor

from benchmarks.protocol.array_files import pictures_of, read_limited
from benchmarks.protocol.prepared_scene import Scene
from benchmarks.report.aggregate import Results
from benchmarks.report.table_layout import Layout, name_of
from benchmarks.run.cells import OK, Cell, one_line
from extrap_train.data.images import to_eight_bits
from extrap_train.errors import InputError
from extrap_train.pictures import error_map

_LARGE_PIXELS = 160
"""From here on pictures are embedded as JPEG: the page stays below some tens of megabytes."""


def page(results: Results, layout: Layout, plots: dict[str, str]) -> str:
    """The page as text."""
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(
        (files("benchmarks.report") / "page.html").read_text("utf-8")
    )
    # No "</script" or "<!--" may stand in the element that holds the data.
    data = json.dumps(_scenes(results)).replace("<", "\\u003c")
    return template.render(
        layout=layout,
        plots=plots,
        data=data,
        title=layout.title,
        count=len(results.cells),
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
        "inputs": [_embedded(view.image) for view in scene.inputs().views],
        "targets": list(scene.draw.targets),
        "angles": [round(math.degrees(angle)) for angle in scene.record.angles_rad],
        "truth": [_embedded(image) for image in truth.images],
        "warp": [_embedded(image) for image in truth.warps],
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
        "images": [_embedded(image) for image in images],
        "errors": [_embedded(image) for image in error_map(images, truth)],
        "scores": {
            name_of(m): cell.metrics[m].per_image
            for m in shown
            if m in cell.metrics and cell.metrics[m].per_image
        },
    }


def _embedded(image: Float[Tensor, "3 h w"]) -> str:
    picture = Image.fromarray(to_eight_bits(image.permute(1, 2, 0)))
    content = io.BytesIO()
    kind = "jpeg" if picture.width >= _LARGE_PIXELS else "png"
    picture.save(content, kind, quality=90)
    return f"data:image/{kind};base64,{base64.b64encode(content.getvalue()).decode()}"
