"""The table of scores that a training prints."""

import io

from rich.console import Console

from extrap_train.tasks.results import _table

_METRICS = (
    "psnr",
    "psnr_holes",
    "psnr_warped",
    "psnr_object",
    "psnr_object_holes",
    "ssim",
    "lpips",
    "lpips_object",
)


def test_every_number_is_whole_in_a_terminal_of_80_columns() -> None:
    said = io.StringIO()
    methods = ("model", "nearest", "inpainted", "mean_fill", "start")
    table = _table({method: dict.fromkeys(_METRICS, 24.9314) for method in methods})
    Console(file=said, width=80).print(table)
    assert said.getvalue().count("24.931") == len(_METRICS) * len(methods)
    assert "…" not in said.getvalue()
