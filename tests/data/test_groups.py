"""Groups of views of one scene: from the same references, and none of them a reference."""

import numpy as np
import pytest
import torch
from orbits import capture, even, ring

from data_prep.build import prepare
from extrap_train.config import PrepConfig
from extrap_train.data.examples import Example, ExampleReader
from extrap_train.data.module import PairModule, TrainingBatches
from extrap_train.data.prepared import PreparedData
from extrap_train.depth.dataset import DatasetDepth
from extrap_train.errors import InputError

FRAMES, REFERENCES, TOGETHER = 24, 3, 4


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> PreparedData:
    """Two captures whose photographs are grey, each as its place in the circle says."""
    folder = tmp_path_factory.mktemp("groups") / "cup"
    sequences = [capture(ring(even(FRAMES)), name, depth=2.5) for name in ("a", "b")]
    options = PrepConfig(image_size=16)
    prepare(
        sequences, DatasetDepth(), options, test_names={"b"}, folder=folder, progress=False,
        source={},
    )  # fmt: skip
    return PreparedData.open(folder)


def _frame(image: torch.Tensor) -> int:
    return round(float(image[0, 0, 0]) * FRAMES)


def _query(example: Example) -> int:
    return _frame(example.image)


def _references(example: Example) -> list[int]:
    return [_frame(image) for image in example.reference_images]


def _apart(one: int, other: int) -> int:
    return min((one - other) % FRAMES, (other - one) % FRAMES)


@pytest.mark.parametrize("split", ["train", "test"])
def test_a_group_is_seen_from_the_references_of_its_first_view(
    data: PreparedData, split: str
) -> None:
    single = ExampleReader([data], split, REFERENCES)
    reader = ExampleReader([data], split, REFERENCES, TOGETHER)
    assert len(reader) == len(single)
    for index in range(0, len(reader), 7):
        (alone,) = single.read(index, REFERENCES, np.random.default_rng(index))
        group = reader.read(index, REFERENCES, np.random.default_rng(index))
        assert len(group) == TOGETHER
        first = group[0]
        assert torch.equal(first.image, alone.image)
        assert torch.equal(first.reference_images, alone.reference_images)
        assert torch.equal(
            first.reference_cameras.world_to_cam, alone.reference_cameras.world_to_cam
        )
        queries = [_query(example) for example in group]
        assert len(set(queries)) == TOGETHER
        for example in group:
            assert not set(queries) & set(_references(example)), "one shows what another paints"
            assert set(_references(example)) == set(_references(first))
            away = [_apart(_query(example), r) for r in _references(example)]
            assert away == sorted(away)


def test_the_views_beside_a_query_are_the_nearest_that_can_be(data: PreparedData) -> None:
    reader = ExampleReader([data], "train", REFERENCES, TOGETHER)
    for index in range(0, len(reader), 5):
        group = reader.read(index, REFERENCES, np.random.default_rng(index))
        query, first = _query(group[0]), _references(group[0])[0]
        can = set(data.queries("cup/a", first)) - {query, *_references(group[0])}
        away = sorted(_apart(query, frame) for frame in can)[: TOGETHER - 1]
        assert [_apart(query, _query(example)) for example in group[1:]] == away


def test_only_references_whose_correction_is_known_show_a_view(
    data: PreparedData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(data.manifest, "correction", {"name": "as if"})
    monkeypatch.setattr(
        data, "flows", lambda _, references, __: torch.ones(len(references), 2, 2, 2)
    )
    reader = ExampleReader([data], "train", REFERENCES, TOGETHER)
    fewer = 0
    for index in range(0, len(reader), 5):
        group = reader.read(index, REFERENCES, np.random.default_rng(index))
        for example in group:
            assert set(_references(example)) <= set(data.partners("cup/a", _query(example)))
            assert _references(group[0])[0] in _references(example)
            assert example.reference_flows is not None
            assert len(example.reference_flows) == len(_references(example))
            fewer += len(_references(example)) < len(_references(group[0]))
    assert fewer


def test_a_pair_with_too_few_others_is_not_trained_on(data: PreparedData) -> None:
    most = max(len(data.queries("cup/a", frame)) for frame in range(FRAMES))
    assert len(ExampleReader([data], "train", 1, most))
    assert not len(ExampleReader([data], "train", 1, most + 1))
    test = ExampleReader([data], "test", 1, FRAMES)
    with pytest.raises(InputError, match=r"smaller model\.joint_views"):
        test.read(0, 1, np.random.default_rng(0))


def test_a_mirrored_group_is_mirrored_as_a_whole(data: PreparedData) -> None:
    reader = ExampleReader([data], "train", REFERENCES, TOGETHER)
    batches = TrainingBatches(reader, REFERENCES, seed=0)
    cameras = data.cameras("cup/a").world_to_cam
    kinds = []
    for pair in range(8):
        batch = batches[[(pair, pair), (100 + pair, pair + 9)]]
        assert batch.joint_views == TOGETHER
        assert len(batch.image) == 2 * TOGETHER
        known = [
            bool((batch.camera.world_to_cam[i] == cameras[_frame(batch.image[i])]).all())
            for i in range(2 * TOGETHER)
        ]
        assert len(set(known[:TOGETHER])) == len(set(known[TOGETHER:])) == 1
        kinds += [known[0], known[TOGETHER]]
    assert set(kinds) == {True, False}


def test_a_batch_holds_as_many_views_in_groups_as_alone(data: PreparedData) -> None:
    def module(joint_views: int) -> PairModule:
        readers = [
            ExampleReader([data], split, REFERENCES, joint_views) for split in ("train", "test")
        ]
        return PairModule(
            *readers, image_size=8, batch_size=8, batches_per_epoch=1, validation_examples=6,
            validation_batch_size=8, references=REFERENCES, workers=0, seed=0,
        )  # fmt: skip

    alone, together = module(1), module(TOGETHER)
    assert together.chosen == alone.chosen
    for loader in ("train_dataloader", "val_dataloader"):
        single = list(getattr(alone, loader)())
        groups = list(getattr(together, loader)())
        assert len(single[0].image) in (6, 8)
        assert all(len(batch.image) == 8 for batch in groups)
    asked = torch.cat([batch.asked().image for batch in groups])
    assert torch.equal(asked, torch.cat([batch.image for batch in single]))
