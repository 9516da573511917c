"""One picture of what `capture_check` has found."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from extrap_train.figures import plot_cameras, save_figure
from extrap_train.geometry.epipolar import epipolar_lines, fundamental_matrix
from extrap_train.geometry.viewpoints import camera_centers, fit_orbit
from extrap_train.reconstruction.capture_check import FAR_PIXELS, CaptureCheck, MatchedViews
from extrap_train.views import View, stack_poses

ROWS = 3
LINES = 10
POINTS = 150
TICKS = (0.1, 0.3, 1, 3, 10, 30, 100, 300)
PROBLEMS, LONGEST = 4, 200
TALLEST = 1.6
"""Of the figure, against its usual height, where photographs are upright."""


def draw_check(check: CaptureCheck, path: Path) -> None:
    """The worst, a middling and the best view with their neighbours; the cameras from above and
    from the side; every view's distances.
    """
    camera = check.views[0].camera
    upright = min(max(camera.height / camera.width, 1), TALLEST)
    figure = plt.figure(figsize=(16, 11 * upright), layout="constrained")
    grid = figure.add_gridspec(ROWS, 4, width_ratios=(1, 1, 1, 1.2))
    known = [m for m in check.matched if np.isfinite(m.distance)] or check.matched
    order = sorted(known, key=lambda m: -np.nan_to_num(m.distance))
    chosen = [order[0], order[len(order) // 2], order[-1]]
    for row, (matched, which) in enumerate(zip(chosen, ("worst", "middling", "best"), strict=True)):
        _draw_row([figure.add_subplot(grid[row, k]) for k in range(3)], check, matched, which)
    _draw_cameras(figure.add_subplot(grid[0, 3]), figure.add_subplot(grid[1, 3]), check)
    _draw_distances(figure.add_subplot(grid[2, 3]), check)
    said = check.problems[:PROBLEMS] or ["nothing looks wrong"]
    if all(view.mask is None for view in check.views):
        said = [*said, "no masks: the whole picture counts as the object's"]
    figure.suptitle("\n".join(map(_shorten, said)), fontsize=11)
    save_figure(figure, path, dpi=80)


def _draw_row(axes: list[Axes], check: CaptureCheck, matched: MatchedViews, which: str) -> None:
    """Features of a view; their epipolar lines and matches in the nearest; points in the third."""
    views = [check.views[index] for index in matched.views]
    for axis, view in zip(axes, views, strict=True):
        _show_photograph(axis, view)
    shown = np.linspace(0, len(matched.pixels) - 1, min(LINES, len(matched.pixels))).astype(int)
    # From left to right, so that colours of neighbours are alike.
    shown = shown[np.argsort(matched.pixels[shown, 0])]
    colours = plt.get_cmap("hsv")(np.linspace(0, 0.9, len(shown)))
    lines = epipolar_lines(
        matched.pixels[shown], fundamental_matrix(views[0].camera, views[1].camera)
    )
    axes[0].scatter(*_uv(matched.pixels[shown]), c=colours, edgecolors="k", s=36)
    for (a, b, c), colour in zip(lines, colours, strict=True):
        if abs(b) > abs(a):
            axes[1].axline((0, -c / b), slope=-a / b, color=colour, linewidth=1)
        else:
            axes[1].axline((-c / a, 0), (-(b + c) / a, 1), color=colour, linewidth=1)
    axes[1].scatter(*_uv(matched.matches[shown]), c=colours, edgecolors="k", s=36)
    some = slice(None, None, max(1, len(matched.third) // POINTS))
    seen, expected = matched.third[some], matched.reprojected[some]
    axes[2].plot(*np.stack([seen, expected]).transpose(2, 0, 1), color="yellow", linewidth=1)
    axes[2].scatter(*_uv(seen), s=28, facecolors="none", edgecolors="lime", linewidths=1)
    axes[2].scatter(*_uv(expected), s=14, c="red", marker="x", linewidths=1)
    axes[0].set_title(f"{which}: {views[0].name}", fontsize=9)
    axes[1].set_title(
        f"{views[1].name}: {len(matched.pixels)} matches,\n"
        f"{_pixels(matched.distance)} from their epipolar lines (median)",
        fontsize=9,
    )
    axes[2].set_title(
        f"{views[2].name}: {len(matched.third)} points of the other two (×),\n"
        f"{_pixels(matched.reprojection)} from where it has them (o)",
        fontsize=9,
    )


def _pixels(value: float) -> str:
    return f"{value:.2f} px" if np.isfinite(value) else "too few to say how far"


def _shorten(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"


def _show_photograph(axis: Axes, view: View) -> None:
    """The photograph, darker outside of its mask."""
    image = view.image.permute(1, 2, 0).numpy()
    if view.mask is not None:
        image = image * (0.35 + 0.65 * view.mask.numpy()[..., None])
    axis.imshow(image, extent=(0, view.camera.width, view.camera.height, 0))
    axis.set_xlim(0, view.camera.width)
    axis.set_ylim(view.camera.height, 0)
    axis.set_axis_off()
    if view.mask is not None and 0 < float(view.mask.mean()) < 1:
        u, v = np.arange(view.camera.width) + 0.5, np.arange(view.camera.height) + 0.5
        axis.contour(u, v, view.mask.numpy(), levels=[0.5], colors="cyan", linewidths=1)


def _draw_cameras(plan: Axes, side: Axes, check: CaptureCheck) -> None:
    """Cameras as arrows along their optical axes, and the triangulated points."""
    cameras = stack_poses([view.camera for view in check.views])
    orbit = fit_orbit(cameras)
    centers = camera_centers(cameras) - orbit.center
    forward = cameras.forward.double().numpy()
    points = np.concatenate([m.points.numpy()[m.distances < FAR_PIXELS] for m in check.matched])
    points = points[np.isfinite(points).all(1)] - orbit.center
    reach = 1.3 * np.abs(centers).max()
    north, east = np.linalg.svd(orbit.axis[None])[2][1:]
    for axis, up, title in (
        (plan, north, "along the orbit's axis"),
        (side, orbit.axis, "across it"),
    ):
        plane = np.stack([east, up], 1)
        axis.scatter(*_uv(points @ plane), s=2, c="0.6")
        plot_cameras(axis, centers, forward, plane, "C0")
        axis.set_xlim(-reach, reach)
        axis.set_ylim(-reach, reach)
        axis.set_title(f"cameras {title}, in the scene's unit", fontsize=9)


def _uv(places: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray]:
    return places[:, 0], places[:, 1]


def _draw_distances(axis: Axes, check: CaptureCheck) -> None:
    numbers = np.arange(len(check.matched)) + 1
    distance = [m.distance for m in check.matched]
    reprojection = [m.reprojection for m in check.matched]
    axis.bar(numbers - 0.2, distance, 0.4, label="matches from epipolar lines")
    axis.bar(numbers + 0.2, reprojection, 0.4, label="points from a third view's")
    axis.axhline(FAR_PIXELS, color="C3", linewidth=1)
    axis.set_yscale("log")
    ticks = [tick for tick in TICKS if tick <= np.nanmax([TICKS[3], *distance, *reprojection])]
    axis.set_yticks(ticks, labels=[f"{tick:g} px" for tick in ticks])
    axis.yaxis.set_minor_formatter("")
    axis.set_xticks(numbers)
    axis.tick_params(axis="x", labelsize=7)
    axis.set_title("median pixels of each view; red: suspect", fontsize=9)
    axis.legend(fontsize=8)
