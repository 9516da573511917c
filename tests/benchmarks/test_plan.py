"""A table's draws have a folder each, whatever their captures are called."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from captures import view_at
from posed_folders import write_transforms

from benchmarks.catalogue import Catalogue
from benchmarks.protocol.captures import Capture
from benchmarks.protocol.draws import Draw, Protocol, draw_sequence
from benchmarks.run.plan import TableFolder, open_protocol, prepare_draws, selected_draws
from benchmarks.run.run_method import build_method
from extrap_train.config import (
    CapturesConfig,
    DatasetDepthConfig,
    QuickConfig,
    RulesConfig,
    TableConfig,
)
from extrap_train.data.scene_spec import open_scene
from extrap_train.errors import InputError
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
    scenes = list(prepare_draws(_TABLE, folder, draws, captures, DatasetDepthConfig()))
    assert {scene.folder.parent for scene in scenes} == {folder.scenes}
    assert len({scene.folder for scene in scenes}) == len(names)
    assert [scene.draw for scene in scenes] == draws
    assert (outside / "precious").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"results", outside.name}


def test_a_corrected_capture_is_prepared_again(tmp_path: Path) -> None:
    """A table's folder may stay where the capture's cameras, depth or photographs change."""
    write_transforms(tmp_path / "mug", [view_at(30 * i) for i in range(9)])
    folder, file = TableFolder(tmp_path / "own"), tmp_path / "mug" / "transforms.json"

    def prepare() -> bytes:
        capture = Capture(replace(open_scene(str(file.parent)), category="apple"))
        depth = DatasetDepthConfig()
        (scene,) = prepare_draws(_TABLE, folder, [_draw(capture)], [capture], depth)
        return (scene.folder / "inputs" / "depth.npy").read_bytes()

    before = prepare()
    assert prepare() == before
    file.write_text(json.dumps(json.loads(file.read_text()) | {"depth_unit_scale_factor": 0.002}))
    assert prepare() != before


def test_a_harmless_name_is_its_folder(tmp_path: Path) -> None:
    draw = replace(_draw(Capture(analytic_capture(9, 24))), sequence="110_13051_23361")
    folder = TableFolder(tmp_path)
    assert folder.scene(draw) == tmp_path / "scenes" / "apple-110_13051_23361-3-random-0"


def test_two_captures_of_one_name_are_refused(tmp_path: Path) -> None:
    """Two folders called garden would be one capture, measured twice."""
    specs = ["synthetic:apple/0000", "synthetic:apple/00000"]
    captures = CapturesConfig(source="scenes", scenes=specs)
    with pytest.raises(InputError, match="two captures are called apple/0000; rename"):
        open_protocol(replace(_TABLE, captures=captures), TableFolder(tmp_path))


def test_a_quick_part_without_captures_is_named() -> None:
    protocol = Protocol(_TABLE.rules, (_draw(Capture(analytic_capture(9, 24))),))
    table = replace(_TABLE, quick=QuickConfig(categories=["hydrant"]))
    assert selected_draws(table, protocol, quick=False) == list(protocol.draws)
    with pytest.raises(InputError, match=r"quick.categories=\['hydrant'\].*give.*\['apple'\]"):
        selected_draws(table, protocol, quick=True)
    with pytest.raises(InputError, match=r"no draw of \['spread'\]"):
        selected_draws(replace(table, draws=["spread"]), protocol, quick=True)


def test_categories_that_the_command_names_are_kept_by_quick_and_stand_in_the_title() -> None:
    catalogue = Catalogue()
    assert catalogue.table("table1").quick.categories == ["hydrant"]
    named = ["captures.categories=[cup,book]", "captures.seed=3"]
    assert catalogue.table("table1", named).quick.categories == []
    assert catalogue.table("table1", named).title == "table1 on cup, book (synthetic)"
    assert catalogue.table("table1", [*named, "title=mine"]).title == "mine"
    both = [*named, "quick.categories=[cup]"]
    assert catalogue.table("table1", both).quick.categories == ["cup"]


@pytest.mark.parametrize(
    ("name", "option", "value", "fits"),
    [
        ("3dgs", "iterations", "abc", False),
        ("3dgs", "iterations", 3.5, False),
        ("3dgs", "iterations", True, False),
        ("3dgs", "iterations", 3, True),
        ("ours", "steps", "abc", False),
        ("ours", "guidance", 2, True),
        ("ours", "guidance", "2", False),
        ("ours", "weights", None, True),
        ("ours", "weights", 3, False),
        ("dngaussian", "hash_levels", 4, True),
    ],
)
def test_an_options_kind_is_what_the_method_declares(
    name: str, option: str, value: object, fits: bool
) -> None:
    method = Catalogue.with_own().method(name, {option: value})
    if fits:
        build_method(method)
        return
    with pytest.raises(InputError, match=f"options.{name}.{option}={value}: "):
        build_method(method)


def test_every_method_of_the_package_can_be_built() -> None:
    catalogue = Catalogue.with_own()
    for name in catalogue.names("method"):
        build_method(catalogue.method(name))
