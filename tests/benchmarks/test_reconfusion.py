"""The community's split is read as its authors hand it out: folders of a few made-up scenes."""

import json
from dataclasses import replace
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pytest

from benchmarks.catalogue import Catalogue
from benchmarks.protocol.captures import freeze, open_captures
from benchmarks.report.aggregate import read_results
from benchmarks.run.plan import TableFolder
from benchmarks.run_table import RunOptions, run_table
from extrap_train.config import CapturesConfig, RulesConfig
from extrap_train.errors import InputError
from extrap_train.jobs.local import LocalLauncher
from tests.benchmarks.split_folders import write_split

_SIZE, _COUNT = 24, 8
_RULES = RulesConfig(image_size=_SIZE, views=[3], draws=["given"], depth="stereo")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_split(tmp_path / "split", _SIZE, _COUNT)
    return tmp_path / "split"


def _captures(root: Path) -> CapturesConfig:
    return CapturesConfig(source="reconfusion", root=str(root))


def test_ids_count_the_frames_in_name_order(root: Path) -> None:
    config = _captures(root)
    (draw,) = freeze(config, _RULES, open_captures(config, [])).draws
    assert (draw.sequence, draw.n_views, draw.draw) == ("34_1479_4753", 3, "given")
    assert [Path(name).stem[-1] for name in draw.inputs] == ["0", "2", "5"]
    assert [Path(name).stem[-1] for name in draw.targets] == ["1", "7"]


@pytest.mark.parametrize("gone", [3, 4, 6])
def test_ids_mean_the_same_where_a_picture_is_missing(root: Path, gone: int) -> None:
    (root / "34_1479_4753" / "images" / f"frame{gone:06d}.png").unlink()
    config = _captures(root)
    (draw,) = freeze(config, _RULES, open_captures(config, [])).draws
    assert [Path(name).stem[-1] for name in (*draw.inputs, *draw.targets)] == list("02517")


def test_ids_mean_the_same_where_a_pose_is_unusable(root: Path) -> None:
    file = root / "34_1479_4753" / "transforms.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        if "000003" in frame["file_path"]:
            frame["transform_matrix"][0][0] = float("nan")
    file.write_text(json.dumps(content))
    config = _captures(root)
    (draw,) = freeze(config, _RULES, open_captures(config, [])).draws
    assert [Path(name).stem[-1] for name in draw.inputs] == list("025")


def test_a_split_that_asks_for_a_missing_picture_names_it(root: Path) -> None:
    (root / "34_1479_4753" / "images" / "frame000005.png").unlink()
    config = _captures(root)
    with pytest.raises(InputError, match=r"frame000005\.png is missing"):
        freeze(config, _RULES, open_captures(config, []))


@pytest.mark.parametrize(
    "content",
    [
        '{"train_ids": [0, 99], "test_ids": [1]}',
        '{"train_ids": [0, -1], "test_ids": [1]}',
        '{"train_ids": [0, 1.9], "test_ids": [2]}',
        '{"train_ids": [0, 0], "test_ids": [1]}',
        '{"train_ids": [0, 1], "test_ids": [2, 1]}',
        '{"train_ids": [0]}',
        "{",
    ],
)
def test_a_damaged_split_is_named(root: Path, content: str) -> None:
    file = root / "34_1479_4753" / "train_test_split_3.json"
    file.write_text(content)
    config = _captures(root)
    with pytest.raises(InputError, match=r"train_test_split_3\.json"):
        freeze(config, _RULES, open_captures(config, []))


def test_a_split_that_is_missing_and_a_wrong_root_are_named(root: Path) -> None:
    config = _captures(root)
    with pytest.raises(InputError, match=r"train_test_split_9\.json"):
        freeze(config, replace(_RULES, views=[9]), open_captures(config, []))
    with pytest.raises(InputError, match=r"no folder in it has a transforms\.json"):
        open_captures(_captures(root / "34_1479_4753"), [])


def test_the_table_runs_with_published_numbers_beside_it(
    fork_server: ForkServerContext, root: Path, tmp_path: Path
) -> None:
    catalogue = Catalogue.with_own()
    words = [f"rules.image_size={_SIZE}", "rules.views=[3]", "methods=[nearest,inpainted]"]
    table = catalogue.table("reconfusion", [f"captures.root={root}", f"output={tmp_path}", *words])
    assert run_table(table, catalogue, RunOptions(launcher=LocalLauncher(1))) == 0
    cells = read_results(TableFolder(tmp_path / "reconfusion")).cells
    assert {cell.status for cell in cells} == {"ok"}
    assert all(cell.metrics["psnr"].value > 8 for cell in cells)
    text = (tmp_path / "reconfusion" / "reconfusion.md").read_text()
    assert "Reported, not measured here" in text
    assert "ReconFusion (second-hand)" in text
