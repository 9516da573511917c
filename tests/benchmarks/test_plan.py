"""A table's draws have a folder each, whatever their captures are called."""

from dataclasses import replace
from pathlib import Path

from benchmarks.captures import Capture
from benchmarks.plan import TableFolder, prepare_draws
from benchmarks.protocol import Draw, draw_sequence
from extrap_train.config import RulesConfig, TableConfig
from extrap_train.views import stack_poses
from tests.benchmarks.analytic import analytic_capture

_TABLE = TableConfig(name="own", rules=RulesConfig(image_size=24, views=[3], draws=["random"]))


def _draw(capture: Capture) -> Draw:
    frames = capture.sequence.frames
    cameras = stack_poses([frame.camera for frame in frames])
    names = [frame.name for frame in frames]
    return draw_sequence("apple", capture.sequence.name, names, cameras, _TABLE.rules)[0]


def test_a_captures_name_leads_out_of_no_folder(tmp_path: Path) -> None:
    """CO3D's annotations are a download: a `sequence_name` can be anything."""
    folder = TableFolder(tmp_path / "results" / "own")
    outside = tmp_path / "escape-3-random-0"
    outside.mkdir()
    (outside / "precious").touch()
    names = ["../../../escape", "../../../../escape", ".._.._.._escape", "/escape", "a/b", "a_b"]
    captures = [Capture(analytic_capture(9, 24, name)) for name in names]
    draws = [_draw(capture) for capture in captures]
    scenes = list(prepare_draws(_TABLE, folder, draws, captures))
    assert {scene.folder.parent for scene in scenes} == {folder.scenes}
    assert len({scene.folder for scene in scenes}) == len(names)
    assert [scene.draw for scene in scenes] == draws
    assert (outside / "precious").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"results", outside.name}


def test_a_harmless_name_is_its_folder(tmp_path: Path) -> None:
    draw = replace(_draw(Capture(analytic_capture(9, 24))), sequence="110_13051_23361")
    folder = TableFolder(tmp_path)
    assert folder.scene(draw) == tmp_path / "scenes" / "apple-110_13051_23361-3-random-0"
