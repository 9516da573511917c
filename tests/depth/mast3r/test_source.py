import copy
import weakref

import pytest
import torch
from oracle import Oracle
from tiny import TINY, plain_state, write_checkpoint
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.config import Mast3rConfig
from extrap_train.depth import DepthSource
from extrap_train.depth.mast3r.source import Mast3rDepth, crop_for, fuse_depth_maps
from extrap_train.depth.sources import depth_source
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import transform, unproject_to_world

SCENE = SCENES["sphere on the ground"]
CONFIG = Mast3rConfig(image_size=64, neighbours=2)


def source_and_views(*azimuths_deg: float):
    """Square views of 80², of which the network sees 48 × 64."""
    views = [render(SCENE, orbit_camera(azimuth_deg, 80)) for azimuth_deg in azimuths_deg]
    seen = [crop_for(view, 64, 16, False).apply(view) for view in views]
    return Mast3rDepth(CONFIG, Oracle(SCENE, 7.0, seen)), views


def check(found, view):
    known = found.confidence > 0
    assert 0.7 < known.float().mean() < 0.8
    error = (found.depth / view.depth - 1).abs()[known]
    assert error.quantile(0.9) < 0.01
    assert not found.depth[~known].any()


def test_depth_maps_of_a_capture_have_the_worlds_scale_and_one_encoding_a_view():
    source, views = source_and_views(0, 15, 30, 45)
    for found, view in zip(source.depth_maps(views), views, strict=True):
        check(found, view)
    assert source.network.encoded == 4


def test_a_view_is_forgotten_with_its_last_pair_and_the_depth_is_that_of_all_pairs(monkeypatch):
    """All estimates at once, as they would lie in memory, against what is fused on the way."""
    source, views = source_and_views(*range(0, 180, 15))
    everything = {i: [] for i in range(len(views))}
    alive, most = weakref.WeakSet(), []
    prepare, pair = Mast3rDepth._prepare, Mast3rDepth._pair
    places = {id(view): i for i, view in enumerate(views)}

    def prepared(self, view):
        made = prepare(self, view)
        alive.add(made.encoding.tokens)
        most.append(len(alive))
        return made

    def kept(self, first, second):
        found = pair(self, first, second)
        for one, depth in zip((first, second), found, strict=True):
            everything[places[id(one.view)]].append(copy.deepcopy(depth))
        return found

    monkeypatch.setattr(Mast3rDepth, "_prepare", prepared)
    monkeypatch.setattr(Mast3rDepth, "_pair", kept)
    for i, found in enumerate(source.depth_maps(views)):
        expected = fuse_depth_maps(everything[i])
        assert torch.equal(found.depth, expected.depth)
        assert torch.equal(found.confidence, expected.confidence)
    assert source.network.encoded == len(views)
    assert max(most) <= 4


def test_depth_map_of_one_view():
    source, views = source_and_views(0, 60)
    check(source.depth_map(views[0], views[1:]), views[0])


def test_point_maps_meet_in_the_first_frame():
    source, views = source_and_views(10, 40)
    maps = source.point_maps(*views)
    world_to_first = views[0].camera.world_to_cam
    for points, confidence, view in (
        (maps.first, maps.first_confidence, views[0]),
        (maps.second, maps.second_confidence, views[1]),
    ):
        world = unproject_to_world(view.depth, view.camera)
        expected = transform(world_to_first, world.flatten(0, 1)).view_as(world)
        error = (points - expected).norm(dim=-1)[confidence > 0]
        assert error.quantile(0.9) < 0.02


def test_a_pair_from_one_place_is_refused_and_a_lone_view_is_unknown():
    source, views = source_and_views(0, 0)
    with pytest.raises(InputError, match="no baseline"):
        source.point_maps(*views)
    with pytest.raises(InputError, match="from another place"):
        source.depth_map(views[0], views[1:])
    assert not any(found.depth.any() for found in source.depth_maps(views))


def test_the_options_and_a_file_make_the_source(tmp_path):
    path = write_checkpoint(plain_state(TINY), tmp_path / "net.pth")
    source = depth_source(Mast3rConfig(checkpoint=str(path), image_size=64))
    assert isinstance(source, DepthSource)
    assert source.image_size == 64
    assert "PointMapNetwork" not in repr(source)
    with torch.no_grad():
        view = render(SCENE, orbit_camera(0, 64))
        assert source.depth_maps([view])[0].depth.shape == (64, 64)
