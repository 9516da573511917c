import json

import numpy as np
import pytest

from data_prep.split import split_sequences
from extrap_train.data.square_frames import held_out_mask
from extrap_train.errors import InputError

NAMES = [f"cup/{i:04d}" for i in range(20)] + [f"book/{i:04d}" for i in range(12)]


def test_every_category_gives_its_test_sequences() -> None:
    split = split_sequences(NAMES, 5)
    assert sum(name.startswith("cup") for name in split.test) == 5
    assert sum(name.startswith("book") for name in split.test) == 5
    assert sorted(split.train + split.test) == sorted(NAMES)


def test_the_split_does_not_depend_on_order_and_hardly_on_the_others() -> None:
    split = split_sequences(NAMES, 5)
    assert split_sequences(NAMES[::-1], 5).to_json() == split.to_json()
    without = split_sequences([name for name in NAMES if name != split.train[0]], 5)
    assert without.test == split.test


def test_at_least_half_is_left_to_train_on() -> None:
    assert len(split_sequences(NAMES[:6], 5).train) == 3


def test_named_test_sequences_with_or_without_category() -> None:
    assert split_sequences(NAMES[:20], {"0003", "cup/0007", "9999"}).test == (
        "cup/0003",
        "cup/0007",
    )
    with pytest.raises(InputError, match="none of the 1 named test sequences"):
        split_sequences(NAMES, {"9999"})
    with pytest.raises(InputError, match="none is left to train on"):
        split_sequences(NAMES[:2], {"0000", "0001"})


def test_a_lone_sequence_is_trained_and_tested_on() -> None:
    split = split_sequences(["cup/0000"], 5)
    assert (split.train, split.test, split.lone) == ((), (), ("cup/0000",))
    assert split.role("cup/0000") == "train and test"
    assert np.flatnonzero(held_out_mask(12)).tolist() == [4, 9]


def test_the_hash_tells_splits_apart() -> None:
    first, second = (json.loads(split_sequences(NAMES, n).to_json()) for n in (4, 5))
    assert first["sha256"] != second["sha256"]


def test_the_only_usable_sequence_is_not_trained_on_when_it_is_named_for_testing() -> None:
    with pytest.raises(InputError, match="all 1 usable sequences are named as test sequences"):
        split_sequences(["cup/0000"], {"0000"})
    assert split_sequences(["cup/0000"], {"book/0000"}).lone == ("cup/0000",)


def test_names_that_match_nothing_are_said(caplog: pytest.LogCaptureFixture) -> None:
    split_sequences(NAMES[:20], {"0003", "cup/9999"})
    assert "1 of 2 named test sequences are not among the usable ones: cup/9999" in caplog.text
