"""The protocol draws as it says, the same for everybody, and notices when it was touched."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.protocol.draws import Protocol, draw_sequence, farthest_frames, write_sealed
from extrap_train.config import RulesConfig
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from tests.orbits import even, looking_at, ring

_RULES = RulesConfig(seeds=[0, 1])
_CAMERAS = ring(even(36))
_NAMES = [f"{i:03d}.png" for i in range(36)]


def _draws(sequence: str = "one", rules: RulesConfig = _RULES):
    return draw_sequence("apple", sequence, _NAMES, _CAMERAS, rules)


def test_nine_of_a_ring_are_spread_over_all_of_it() -> None:
    pool = farthest_frames(_CAMERAS, 9)
    gaps = np.diff([*pool, pool[0] + 36]) * 10
    assert len(set(pool)) == 9
    assert gaps.min() >= 20
    assert gaps.max() <= 50


def test_the_pool_begins_at_the_camera_nearest_to_the_middle() -> None:
    positions = np.array([[x, -3.0, 0.0] for x in (0.0, 1.0, 2.0, 3.0, 10.0)])
    assert farthest_frames(looking_at(positions, np.zeros(3)), 2) == [3, 4]


def test_inputs_and_targets_divide_the_same_pool() -> None:
    pools = set()
    for draw in _draws():
        assert len(draw.inputs) == draw.n_views
        assert not set(draw.inputs) & set(draw.targets)
        pools.add(frozenset(draw.inputs) | frozenset(draw.targets))
    assert len(pools) == 1
    assert len(pools.pop()) == 9


def test_six_views_hold_the_three() -> None:
    by_key = {(d.draw, d.seed, d.n_views): set(d.inputs) for d in _draws()}
    for kind in _RULES.draws:
        for seed in _RULES.seeds:
            assert by_key[kind, seed, 3] < by_key[kind, seed, 6]


def _widest_gap_deg(names: tuple[str, ...]) -> float:
    azimuths = sorted(10 * int(name[:3]) for name in names)
    return max(np.diff([*azimuths, azimuths[0] + 360]))


def test_spread_goes_around_and_one_sided_stays_on_a_side() -> None:
    gaps = {"spread": [], "one_sided": [], "random": []}
    for sequence in map(str, range(12)):
        for draw in _draws(sequence):
            if draw.n_views == 3:
                gaps[draw.draw].append(_widest_gap_deg(draw.inputs))
    assert max(gaps["spread"]) <= 180
    assert min(gaps["one_sided"]) >= 240
    assert min(gaps["random"]) < 200 < max(gaps["random"])


def test_one_sided_inputs_are_neighbours_about_the_scene() -> None:
    angles = pairwise_angles(_CAMERAS, scene_center(_CAMERAS))
    for draw in _draws():
        if draw.draw == "one_sided" and draw.n_views == 3:
            chosen = [int(name[:3]) for name in draw.inputs]
            assert angles[np.ix_(chosen, chosen)].max() <= math.radians(100)


_HALVES = RulesConfig(draws=["halves"], seeds=[0, 1])


@pytest.mark.parametrize("sequence", ["one", "two", "three", "four"])
def test_halves_are_disjoint_in_angle(sequence: str) -> None:
    """Around the ring, all inputs come one after another, and so do all targets."""
    draws = _draws(sequence, _HALVES)
    assert draws == _draws(sequence, _HALVES)
    assert [(d.draw, d.seed, d.n_views) for d in draws] == [
        ("halves", seed, n) for seed in (0, 1) for n in (3, 6)
    ]
    for draw in draws:
        assert (len(draw.inputs), len(draw.targets)) == (draw.n_views, 6)
        around = [name in draw.inputs for name in sorted({*draw.inputs, *draw.targets})]
        changes = sum(a != b for a, b in zip(around, [*around[1:], around[0]], strict=True))
        assert changes == 2
    three, six = (next(d for d in draws if d.n_views == n) for n in (3, 6))
    assert set(three.inputs) < set(six.inputs)
    assert three.targets == six.targets


def test_halves_divide_the_frames_by_the_farthest_pair() -> None:
    """On an arc, too, where the poles are its ends."""
    cameras = ring(even(36))[torch.arange(18)]
    for seed in range(4):
        rules = RulesConfig(draws=["halves"], seeds=[seed])
        for draw in draw_sequence("apple", "arc", _NAMES[:18], cameras, rules):
            sides = [{int(n[:3]) < 9 for n in part} for part in (draw.inputs, draw.targets)]
            assert [len(side) for side in sides] == [1, 1]
            assert sides[0] != sides[1]


def test_a_half_of_too_few_frames_is_named() -> None:
    rules = RulesConfig(draws=["halves"], views=[8])
    with pytest.raises(InputError, match=r"apple/short: its halves have.*rules\.views"):
        draw_sequence("apple", "short", _NAMES[:10], _CAMERAS[torch.arange(10)], rules)


def test_draws_depend_on_capture_and_seed_alone() -> None:
    assert _draws() == _draws()
    random = {d.seed: d.inputs for d in _draws() if d.draw == "random" and d.n_views == 3}
    assert random[0] != random[1]
    other = [d.inputs for d in _draws("two") if d.draw == "random" and d.n_views == 3]
    assert other[0] != random[0]


def test_too_few_frames_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"apple/short: has 8 usable frames.*picks 9"):
        draw_sequence("apple", "short", _NAMES[:8], _CAMERAS[torch.arange(8)], _RULES)


def test_a_frozen_protocol_comes_back_and_its_hash_guards_it(tmp_path: Path) -> None:
    file = tmp_path / "protocol.json"
    protocol = Protocol(_RULES, tuple(_draws()))
    write_sealed(file, protocol)
    assert Protocol.read(file) == protocol
    assert Protocol.read(file).sha256 == protocol.sha256
    content = json.loads(file.read_text())
    content["draws"][0]["inputs"][0], content["draws"][0]["targets"][0] = (
        content["draws"][0]["targets"][0],
        content["draws"][0]["inputs"][0],
    )
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match="not what its hash"):
        Protocol.read(file)
    file.write_text('{"rules": {"nine": 9}}')
    with pytest.raises(InputError, match=r"protocol\.json"):
        Protocol.read(file)
