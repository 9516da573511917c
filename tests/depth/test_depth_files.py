import math
import zipfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from traced_scenes import SCENES, orbit_camera, render

from benchmarks.protocol.draws import Draw
from benchmarks.run import plan
from data_prep.model_cache import PrepModels
from extrap_train import open_views, warp_view
from extrap_train.cli import TRAIN, compose_config
from extrap_train.config import FilesDepthConfig, FlowMatcherConfig, TableConfig
from extrap_train.data.scene_spec import open_scene
from extrap_train.depth import DepthSource, NoDepthError
from extrap_train.depth.sources import depth_source, weight_files
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.reconstruction.inputs import first_views
from extrap_train.tasks.scene_inputs import scene_manifest
from extrap_train.views import View, WholePhotograph

SCENE = SCENES["box on the ground"]


def photographs(azimuths_deg=(0, 12, 24), size=96) -> list[View]:
    views = [render(SCENE, orbit_camera(azimuth, size)) for azimuth in azimuths_deg]
    return [
        replace(v, name=f"{i}.jpg", photograph=WholePhotograph(f"images/{i}.jpg", v.camera))
        for i, v in enumerate(views)
    ]


def write(folder, view, depth, **arrays):
    file = (folder / view.photograph.path).with_suffix(".npz")
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, depth=np.asarray(depth), **arrays)
    return file


def source(folder, **options):
    config = FilesDepthConfig(folder=str(folder), matcher=FlowMatcherConfig(), **options)
    return depth_source(config)


def median_error(found, view):
    known = found.confidence > 0
    assert known.float().mean() > 0.9
    return float((found.depth / view.depth - 1).abs()[known].median())


@pytest.fixture(scope="module")
def views():
    return photographs()


def test_depth_of_unknown_scale_gives_the_exact_warp(tmp_path, views, caplog):
    for view in views:
        k, pose = view.camera.intrinsics, view.camera.world_to_cam
        write(tmp_path, view, view.depth / 40, intrinsics=k, world_to_cam=pose)
    files = source(tmp_path)
    assert isinstance(files, DepthSource)
    maps = files.depth_maps(views)
    assert max(median_error(found, view) for found, view in zip(maps, views, strict=True)) < 0.005
    assert "differ by 0." in caplog.text
    found = [replace(v, depth=m.depth) for v, m in zip(views[:2], maps[:2], strict=True)]
    warp, exact = (warp_view(given, views[2].camera, size=96) for given in (found, views[:2]))
    assert (warp.mask != exact.mask).float().mean() < 0.02
    both = (warp.mask * exact.mask)[:, None] > 0
    assert ((warp.image - exact.image).abs() * both).mean() < 0.01


def test_noise_hardly_moves_the_scale(tmp_path, views):
    rng = np.random.default_rng(0)
    for view in views:
        write(tmp_path, view, view.depth * 3 * np.exp(0.05 * rng.normal(size=view.depth.shape)))
    for found, view in zip(source(tmp_path).depth_maps(views), views, strict=True):
        assert abs(float((found.depth / view.depth).median()) - 1) < 0.015


def test_every_view_may_have_a_scale_of_its_own(tmp_path, views):
    for scale, view in zip((0.2, 1.0, 9.0), views, strict=True):
        write(tmp_path, view, view.depth * scale)
    with pytest.raises(InputError, match=r"\d\.jpg.*depth\.max_residual"):
        source(tmp_path).depth_maps(views)
    for found, view in zip(source(tmp_path, align="view").depth_maps(views), views, strict=True):
        assert median_error(found, view) < 0.01


def test_inverse_depth_of_unknown_scale_and_shift(tmp_path, views):
    for shift, view in enumerate(views):
        write(tmp_path, view, 3 / view.depth + shift, confidence=np.full((96, 96), 0.5))
    for found, view in zip(source(tmp_path, align="affine").depth_maps(views), views, strict=True):
        assert median_error(found, view) < 0.02
        assert found.confidence.max() <= 0.5


def test_one_wrong_file_is_refused_by_its_name(tmp_path, views):
    for view, factor in zip(views, (1, 1, 1.5), strict=True):
        write(tmp_path, view, view.depth * factor)
    with pytest.raises(InputError, match=r"2\.jpg.*max_residual"):
        source(tmp_path).depth_maps(views)


def test_crops_of_a_wide_photograph_take_their_part_of_a_file_of_another_size(tmp_path):
    wide = []
    for view in photographs():
        cut = view.cropped(20, 0, 60, 96)
        whole = WholePhotograph(view.photograph.path, cut.camera)
        wide.append(replace(cut, photograph=whole))
        small = cut.resized(42, 70).depth  # the aspect changes by 4 %, as a network's patches do
        write(tmp_path, cut, small, intrinsics=cut.camera.resized(42, 70).intrinsics)
    squares = [view.squared(48) for view in wide]
    for found, view in zip(source(tmp_path).depth_maps(squares), squares, strict=True):
        assert median_error(found, view) < 0.02


def test_the_world_of_a_completion_may_have_another_unit(tmp_path, views):
    for view in views:
        write(tmp_path, view, view.depth / 7, world_to_cam=view.camera.world_to_cam)
    world = WorldFrame(torch.tensor([0.1, 0.0, 0.2]), 2.5)
    made, confidences = first_views(views, source(tmp_path), world, 48)
    for new, sure, view in zip(made, confidences, views, strict=True):
        wanted = view.squared(48).depth / 2.5
        assert ((new.depth / wanted - 1).abs()[sure > 0.3].median()) < 0.02


@pytest.mark.parametrize("kind", ["png", "npy", "jpg.npy"])
def test_pictures_in_millimetres_and_plain_arrays(tmp_path, views, kind):
    for view in views:
        file = (tmp_path / view.photograph.path).with_suffix(f".{kind}")
        file.parent.mkdir(exist_ok=True)
        if kind == "png":
            millimetres = (view.depth * 1000).round().numpy().astype(np.uint16)
            Image.fromarray(millimetres).save(file)
        else:
            np.save(file, np.asfortranarray(view.depth.numpy().astype(np.float16)))
    found = source(tmp_path).depth_map(views[0], views[1:])
    assert median_error(found, views[0]) < 0.01
    assert len(weight_files(FilesDepthConfig(folder=str(tmp_path)))) == 3


@pytest.mark.parametrize("align", ["scene", "affine"])
@pytest.mark.parametrize("kind", ["png", "npz"])
def test_what_a_sensor_did_not_measure_is_unknown(tmp_path, views, kind, align):
    for view in views:
        values = (20_000 / view.depth if align == "affine" else 1000 * view.depth).round().numpy()
        if kind == "png":
            values = values.astype(np.uint16)
        values[:20] = 65_535 if kind == "png" else np.nan
        file = write(tmp_path, view, values)
        if kind == "png":
            file.unlink()
            Image.fromarray(values).save(file.with_suffix(".png"))
    for found, view in zip(source(tmp_path, align=align).depth_maps(views), views, strict=True):
        assert not found.reliable()[:20].any()
        known = found.reliable()[20:]
        assert (known > 0).float().mean() > 0.9
        assert float((known / view.depth[20:] - 1).abs()[known > 0].median()) < 0.02


def _wrong(view):
    k, pose = view.camera.intrinsics.clone(), view.camera.world_to_cam.clone()
    long, off, moved, turned = k.clone(), k.clone(), pose.clone(), pose.clone()
    long[0, 0] *= 1.1
    off[0, 2] += 8
    moved[0, 3] += 0.1
    angle = math.radians(3)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    turned[:2] = turn @ turned[:2]
    return {
        "focal": {"intrinsics": long},
        "principal point": {"intrinsics": off},
        "position": {"world_to_cam": moved},
        "rotation": {"world_to_cam": turned},
        "of no matrix": {"intrinsics": torch.zeros(3, 3)},
        "of another shape": {"world_to_cam": torch.eye(3)},
        "confidence beyond 1": {"confidence": torch.full((96, 96), 1.5)},
        "negative confidence": {"confidence": torch.full((96, 96), -0.5)},
        "confidence of another size": {"confidence": torch.ones(3, 3)},
    }


@pytest.mark.parametrize("what", list(_wrong(photographs((0,))[0])))
def test_files_of_another_camera_are_refused(tmp_path, views, what):
    for view in views:
        write(tmp_path, view, view.depth)
    file = write(tmp_path, views[1], views[1].depth, **_wrong(views[1])[what])
    with pytest.raises(InputError, match=str(file)):
        source(tmp_path).depth_maps(views)


def _bad_files(view):
    huge = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6)}
    return {
        "of another aspect": lambda file: np.savez(file, depth=view.depth[:40]),
        "truncated": lambda file: file.write_bytes(file.read_bytes()[:-200]),
        "no archive": lambda file: file.write_bytes(b"PK\x03\x04 nothing"),
        "huge": lambda file: _write_npy_header(file, huge),
        "pickled": lambda file: np.savez(file, depth=np.array([{"a": 1}], dtype=object)),
        "empty": lambda file: np.savez(file, depth=np.zeros((96, 96))),
        "without depth": lambda file: np.savez(file, points=np.zeros((96, 96))),
        "in three dimensions": lambda file: np.savez(file, depth=np.ones((3, 96, 96))),
    }


def _write_npy_header(file, header):
    with zipfile.ZipFile(file, "w") as archive, archive.open("depth.npy", "w") as part:
        np.lib.format.write_array_header_1_0(part, header)
        part.write(b"1234")


@pytest.mark.parametrize("what", list(_bad_files(photographs((0,))[0])))
def test_damaged_files_are_named(tmp_path, views, what):
    for view in views:
        write(tmp_path, view, view.depth)
    file = (tmp_path / views[1].photograph.path).with_suffix(".npz")
    _bad_files(views[1])[what](file)
    with pytest.raises(InputError, match=str(file)) as raised:
        source(tmp_path).depth_maps(views)
    assert "\n" not in str(raised.value)


def test_views_without_a_file_are_unknown_and_named(tmp_path, views, caplog):
    for view in views[:2]:
        write(tmp_path, view, view.depth)
    generated = replace(views[0], photograph=None, name="generated")
    maps = source(tmp_path).depth_maps([*views, generated])
    assert [bool(found.depth.any()) for found in maps] == [True, True, False, False]
    assert "2 of 4" in caplog.text
    assert "2.jpg" in caplog.text
    for missing in (views[2], generated):
        with pytest.raises(InputError, match=r"depth\.folder"):
            source(tmp_path).depth_map(missing, views[:2])
    with pytest.raises(InputError, match=r"images/2\.jpg"):
        source(tmp_path).depth_maps([views[2]])


def test_two_files_for_one_photograph_are_ambiguous(tmp_path, views):
    file = write(tmp_path, views[0], views[0].depth)
    np.save(file.with_suffix(".npy"), views[0].depth)
    with pytest.raises(InputError, match=r"0\.np"):
        source(tmp_path).depth_maps(views)


def test_views_in_one_place_do_not_tell_the_scale(tmp_path, views):
    near = photographs((0, 0.05))
    for view in near:
        write(tmp_path, view, view.depth)
    for given in (near, near[:1]):
        with pytest.raises(NoDepthError):
            source(tmp_path).depth_maps(given)


def test_depth_of_another_scene_is_no_input_of_a_result(tmp_path):
    """One folder may hold the depth of a whole data set."""
    scene = "synthetic:hydrant/0003"
    words = ["category=hydrant", f"scene={scene}", "depth=files", f"depth.folder={tmp_path}"]
    config = compose_config(TRAIN, ["task=scene", *words])
    frames = open_scene(scene).frames[:2]
    for sequence in ("0003", "0004"):
        (tmp_path / "hydrant" / sequence).mkdir(parents=True)

    def inputs(sequence, value):
        np.save(tmp_path / "hydrant" / sequence / "frame000000.npy", np.full((2, 2), value))
        return scene_manifest(config, frames, {}, {}).inputs

    first = inputs("0003", 1.0)
    assert inputs("0004", 1.0) == first
    assert inputs("0003", 2.0) != first


def test_a_renamed_file_is_depth_of_another_photograph(tmp_path, monkeypatch):
    """Tables and preparations are made again, since the depth may be another."""
    monkeypatch.setattr(plan, "prepare_scene", lambda *parts: parts[-1])
    np.save(tmp_path / "1.npy", np.ones((2, 2)))
    draw = Draw("apple", "one", 3, "random", 0, ("a",), ("b",))
    capture = SimpleNamespace(sequence=SimpleNamespace(category="apple", name="one", frames=()))
    depth = FilesDepthConfig(folder=str(tmp_path), matcher=FlowMatcherConfig())

    def identities():
        table, folder = TableConfig(name="t"), plan.TableFolder(tmp_path.with_name("table"))
        (origin,) = plan.prepare_draws(table, folder, [draw], [capture], depth)
        return origin, PrepModels(depth, None).depth_identity

    before = identities()
    assert identities() == before
    (tmp_path / "1.npy").rename(tmp_path / "2.npy")
    assert not set(identities()) & set(before)


@pytest.mark.parametrize("folder", [None, "", "/nowhere"])
def test_the_folder_must_be_there(folder):
    with pytest.raises(InputError, match=r"depth\.folder"):
        depth_source(FilesDepthConfig(folder=folder))


def test_a_scene_is_opened_with_the_depth_of_files(tmp_path):
    scene = "synthetic:hydrant/0003"
    exact = open_views(scene, 4, size=64)
    for view in exact:
        camera = view.camera
        whole = WholePhotograph(f"hydrant/0003/{view.name}", camera)
        write(tmp_path, replace(view, photograph=whole), view.depth * 12)
    options = FilesDepthConfig(folder=str(tmp_path), image_size=64)
    for found, view in zip(open_views(scene, 4, options, size=64), exact, strict=True):
        both = (found.depth > 0) & (view.depth > 0)
        assert (found.depth / view.depth - 1).abs()[both].median() < 0.02
