"""Published checkpoints are rows of a table, as they were downloaded or as diffusers keeps them."""

from multiprocessing.context import ForkServerContext
from pathlib import Path

import pytest
import torch
from published_networks import Reference

from benchmarks.catalogue import Catalogue
from benchmarks.methods.diffusion import Diffusion
from benchmarks.report.aggregate import read_results
from benchmarks.run.plan import TableFolder
from benchmarks.run_table import RunOptions, run_table
from extrap_train import open_generator
from extrap_train.diffusion.model_files import save_model
from extrap_train.errors import InputError
from tests.benchmarks.tables import without_plots

_SMALL = [
    *("captures.frames=8", "captures.render_size=64", "captures.sequences=1"),
    *("rules.image_size=32", "rules.pool=3", "rules.views=[2]"),
    *("scoring.dists=false", "scoring.lpips=[]", "columns=[psnr]"),
]


@pytest.fixture(scope="module")
def files(references: dict[str, Reference], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ZeroNVS's file and MegaScenes's folder, and the latter in diffusers' own layout."""
    folder = tmp_path_factory.mktemp("files")
    torch.save({"state_dict": references["zeronvs"].state}, folder / "zeronvs.ckpt")
    (folder / "iter_7").mkdir()
    torch.save(references["megascenes"].state, folder / "iter_7" / "pytorch_model.bin")
    save_model(open_generator(str(folder / "iter_7")).model, folder / "plain")
    (folder / "plain" / "extrapolation_model.json").unlink()
    return folder


def _run(output: Path, weights: dict[str, Path]) -> None:
    catalogue = Catalogue()
    given = [f"options.{name}.weights={place}" for name, place in weights.items()]
    given += [f"options.{name}.{o}=1" for name in weights for o in ("steps", "guidance")]
    words = [*_SMALL, f"methods=[{','.join(weights)}]", *given, f"output={output}"]
    table = catalogue.table("untrained", words)
    with without_plots():
        assert run_table(table, catalogue, RunOptions(workers=1)) == 0


def test_every_layout_is_weights(files: Path) -> None:
    places = {"zeronvs.ckpt": "zeronvs", "iter_7": "megascenes", "plain": "megascenes"}
    for name, family in places.items():
        given = Diffusion(family=family, weights=str(files / name)).weight_files("hydrant")
        assert all(path.is_file() and path.is_relative_to(files / name) for path in given)
        assert given


@pytest.mark.slow
@pytest.mark.usefixtures("rendered_once")
def test_every_layout_is_a_row(files: Path, fork_server: ForkServerContext, tmp_path: Path) -> None:
    pictures = []
    for run, megascenes in enumerate(("iter_7", "plain")):
        output = tmp_path / str(run)
        _run(output, {"zeronvs": files / "zeronvs.ckpt", "megascenes": files / megascenes})
        cells = {c.method: c for c in read_results(TableFolder(output / "untrained")).cells}
        assert {cell.status for cell in cells.values()} == {"ok"}
        assert cells["zeronvs"].given["made at"] == "256 px"
        pictures.append({name: cell.images for name, cell in cells.items()})
    assert pictures[0] == pictures[1]
    assert pictures[0]["zeronvs"] != pictures[0]["megascenes"]


def test_a_row_of_another_family_ends_the_table_before_anything_runs(
    files: Path, fork_server: ForkServerContext, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"method megascenes: .*zeronvs\.ckpt: is a") as it:
        _run(tmp_path, {"zeronvs": files / "zeronvs.ckpt", "megascenes": files / "zeronvs.ckpt"})
    assert "\n" not in str(it.value)
    assert not (tmp_path / "untrained" / "scenes").exists()
