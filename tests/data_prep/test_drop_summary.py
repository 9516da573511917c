"""Reasons, summed up."""

from data_prep.filter import ReasonGroup, group_reasons

CUT = (
    "12 of 12 frames cannot be used, the first because of /out/eyes9_run/{}/000{}.png: no such file"
)


def test_reasons_that_differ_in_numbers_are_one_without_them() -> None:
    kinds = group_reasons(
        ["covers 86° < 300°", "too few", "covers 8.6° < 300°", "covers 86° < 300°"]
    )
    assert kinds == [ReasonGroup(3, "covers 86° < 300°", True), ReasonGroup(1, "too few", False)]
    assert [kind.short for kind in kinds] == ["covers #° < #°", "too few"]
    assert [kind.counted for kind in kinds] == [
        "3 times, for instance covers 86° < 300°",
        "once too few",
    ]


def test_reasons_that_differ_in_paths_are_one_and_its_path_can_be_opened() -> None:
    one, other = CUT.format("a b", 1), CUT.format("two", 2)
    (kind,) = group_reasons([one, other])
    assert kind.short == f"for instance {one}"
    assert kind.counted == f"2 times, for instance {one}"
    assert group_reasons([one])[0].short == one
    assert [kind.count for kind in group_reasons([one, f"{other} and more"])] == [1, 1]


def test_names_with_slashes_are_no_paths() -> None:
    assert [kind.short for kind in group_reasons(["32 px/s", "7 px/s", "7 px/m"])] == [
        "# px/s",
        "# px/m",
    ]
