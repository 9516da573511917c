import json
import os
import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from orbits import capture, even, ring, textured_capture

from data_prep import sequence_job
from data_prep.model_cache import PrepModels
from data_prep.preparation import prepare
from data_prep.sequence_job import PrepContext, SequenceJob, prepare_sequence
from extrap_train.config import FlowMatcherConfig, PrepConfig
from extrap_train.data import frame_files
from extrap_train.data.prepared import PreparedData
from extrap_train.data.square_frames import block_median, object_square
from extrap_train.depth import DatasetDepth, DepthMap, DepthSource
from extrap_train.errors import InputError
from extrap_train.jobs import Died
from extrap_train.views import View

OPTIONS = PrepConfig(image_size=16)


@dataclass(frozen=True)
class CountingDepth(DatasetDepth):
    """Depth of the data set, with a record of the sequences it was asked for."""

    calls: tuple[list[int], ...] = ([],)

    def __repr__(self) -> str:
        return "CountingDepth()"

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        self.calls[0].append(len(views))
        return super().depth_maps(views)


def run(folder: Path, sequences, test_names=2, depth: DepthSource | None = None, options=OPTIONS):
    return prepare(
        sequences,
        depth or DatasetDepth(),
        options,
        test_names=test_names,
        folder=folder,
        progress=False,
    )


def captures(count: int, **traits):
    return [capture(ring(even(24)), f"{index:04d}", **traits) for index in range(count)]


def test_a_second_run_does_nothing_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depth = CountingDepth(calls=([],))
    first = run(tmp_path / "cup", captures(3), depth=depth)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "cup").rglob("*")}
    second = run(tmp_path / "cup", captures(3), depth=depth)
    assert len(depth.calls[0]) == 3
    assert before == {p: p.stat().st_mtime_ns for p in (tmp_path / "cup").rglob("*")}
    assert "prepared already" in capsys.readouterr().out
    assert first.manifest == second.manifest


def test_other_pair_options_keep_the_frames_other_sizes_do_not(tmp_path: Path) -> None:
    depth = CountingDepth(calls=([],))
    many = run(tmp_path / "cup", captures(3), depth=depth)
    few = run(tmp_path / "cup", captures(3), depth=depth, options=replace(OPTIONS, max_uses=2))
    assert len(few.pairs("train")) < len(many.pairs("train"))
    assert len(depth.calls[0]) == 3
    large = run(tmp_path / "cup", captures(3), depth=depth, options=PrepConfig(image_size=20))
    assert large.images("cup/0001", [0]).shape == (1, 3, 20, 20)
    assert len(depth.calls[0]) == 6


def test_other_test_sequences_are_taken_for_another_preparation(tmp_path: Path) -> None:
    for name in ("0001", "0002"):
        data = run(tmp_path / "cup", captures(3), test_names=[name])
        assert [key for key, role in data.roles.items() if role == "test"] == [f"cup/{name}"]


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    depth = CountingDepth(calls=([],))

    def interrupt(*, depth: bool) -> View:
        raise KeyboardInterrupt

    sequences = captures(3)
    frames = (replace(sequences[2].frames[0], load=interrupt), *sequences[2].frames[1:])
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "cup", [*sequences[:2], replace(sequences[2], frames=frames)], depth=depth)
    with pytest.raises(InputError, match="no finished preparation"):
        PreparedData.open(tmp_path / "cup")
    data = run(tmp_path / "cup", sequences, depth=depth)
    assert len(depth.calls[0]) == 3
    fresh = run(tmp_path / "fresh", sequences)
    assert fresh.manifest["pairs"] == data.manifest["pairs"]


def test_what_a_killed_run_has_half_written_is_removed(tmp_path: Path) -> None:
    killed = f"{socket.gethostname().partition('.')[0]}-999999"
    for kind in ("frames", "pairs"):
        half = tmp_path / "cup" / kind / "cup" / f".0001.{killed}.tmp"
        half.mkdir(parents=True)
        (half / "frames.npy").write_bytes(b"half of it")
    (tmp_path / "cup" / f".preparation.json.{killed}.tmp").write_bytes(b"{")
    run(tmp_path / "cup", captures(3))
    assert not list((tmp_path / "cup").rglob("*.tmp"))


def test_two_runs_give_the_same_files(tmp_path: Path) -> None:
    for name in ("one", "two"):
        run(tmp_path / name, captures(3))
    for file in (tmp_path / "one").rglob("*.*"):
        twin = tmp_path / "two" / file.relative_to(tmp_path / "one")
        assert file.is_dir() or file.read_bytes() == twin.read_bytes()


def test_a_failing_sequence_is_reported_and_the_rest_goes_on(tmp_path: Path) -> None:
    sequences = [*captures(3), capture(ring(even(24)), "bad", broken=(4, 5, 6))]
    sequences += [capture(ring(even(24, 90)), "arc"), capture(ring(even(24)), "flat", depth=0.0)]
    black = lambda index: torch.zeros(48, 64)  # noqa: E731
    sequences += [capture(ring(even(24)), "black", mask=black)]
    data = run(tmp_path / "cup", sequences)
    reasons = data.sequences.set_index("sequence")["reason"]
    assert "3 of 24 frames cannot be used" in reasons["cup/bad"]
    assert "bad/frame4.jpg: truncated; restore it" in reasons["cup/bad"]
    assert "covers 86°" in reasons["cup/arc"]
    assert "no depth is known" in reasons["cup/flat"]
    assert "masks are all black" in reasons["cup/black"]
    assert data.sequences["kept"].sum() == 3
    assert {pair.sequence for pair in data.pairs("train")} <= {f"cup/000{i}" for i in range(3)}


def test_a_single_bad_frame_is_left_out_of_its_sequence(tmp_path: Path) -> None:
    sequences = [*captures(3), capture(ring(even(24)), "one_bad", broken=(4,))]
    data = run(tmp_path / "cup", sequences)
    names = data.names("cup/one_bad")
    assert len(names) == 23
    assert "frame4" not in names
    assert len(data.cameras("cup/one_bad").world_to_cam) == 23


def test_nothing_left_sums_up_the_reasons(tmp_path: Path) -> None:
    arcs = [capture(ring(even(24, 90)), str(i)) for i in range(3)]
    options = replace(OPTIONS, full_circle="require")
    with pytest.raises(InputError, match=r"none of the 3 sequences of cup.*3 times covers 86°"):
        run(tmp_path / "cup", arcs, options=options)
    with pytest.raises(InputError, match="no sequence to prepare"):
        run(tmp_path / "cup", [])


def test_nothing_left_of_damaged_files_says_so_once_and_advises_to_mend_them(
    tmp_path: Path,
) -> None:
    damaged = [capture(ring(even(24)), f"/s{i}", broken=range(24)) for i in range(3)]
    with pytest.raises(InputError) as caught:
        run(tmp_path / "cup", damaged)
    assert str(caught.value) == (
        "none of the 3 sequences of cup can be used: 3 times, for instance 24 of 24 frames cannot "
        "be used, the first because of /s0/frame0.jpg: truncated; restore it. To go on, mend what "
        "is named or add sequences"
    )
    arc = capture(ring(even(24, 90)), "arc")
    options = replace(OPTIONS, full_circle="require")
    with pytest.raises(InputError, match=r"To go on, mend what is named or loosen prep\.\*"):
        run(tmp_path / "cup", [*damaged, arc], options=options)


def test_a_nan_camera_drops_its_sequence(tmp_path: Path) -> None:
    camera = ring(even(24))
    camera.world_to_cam[3] = float("nan")
    data = run(tmp_path / "cup", [*captures(2), capture(camera, "nan")])
    assert "frame3" in data.sequences.set_index("sequence").loc["cup/nan", "reason"]


def test_a_lone_sequence_holds_frames_out(tmp_path: Path) -> None:
    data = run(tmp_path / "cup", captures(1))
    held = {4, 9, 14, 19}
    train, test = data.pairs("train"), data.pairs("test")
    assert not held & {*train.query.tolist(), *train.reference.tolist()}
    assert set(test.query.tolist()) == held
    assert not held & set(test.reference.tolist())
    assert not held & set(data.reference_frames("cup/0000").tolist())


def test_held_out_photographs_lend_no_depth(tmp_path: Path) -> None:
    """What is tested on must not shape the references: depth is estimated without it."""
    depth = CountingDepth(calls=([],))
    data = run(tmp_path / "cup", captures(1), depth=depth)
    assert depth.calls[0] == [20], "24 frames, of which every fifth (4) is held out"
    (sequence,) = data.sequences["sequence"]
    depths = data.depths(sequence, list(range(24)))
    assert [i for i in range(24) if not depths[i].any()] == [4, 9, 14, 19]


def test_a_frame_without_depth_is_no_reference(tmp_path: Path) -> None:
    sequences = captures(2)
    frame = sequences[0].frames[6]
    empty = replace(frame, load=lambda depth: replace(frame.load(), depth=torch.zeros(48, 64)))
    frames = (*sequences[0].frames[:6], empty, *sequences[0].frames[7:])
    data = run(tmp_path / "cup", [replace(sequences[0], frames=frames), sequences[1]])
    pairs = [p for s in ("train", "test") for p in data.pairs(s) if p.sequence == "cup/0000"]
    assert 6 in {pair.query for pair in pairs}
    assert 6 not in {pair.references[0] for pair in pairs}
    assert 6 not in data.reference_frames("cup/0000")


@pytest.mark.parametrize(("module", "file"), [(frame_files, "FRAMES"), (sequence_job, "FLOWS")])
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    module: ModuleType, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, file, "/dev/full")
    with pytest.raises(InputError, match=r"no space left.*MiB needed") as caught:
        run(tmp_path / "cup", captures(2))
    assert str(tmp_path / "cup") in str(caught.value)
    made = [path for path in (tmp_path / "cup").rglob("*.npy") if path.is_file()]
    assert len(made) == (1 if module is sequence_job else 0), "the frames of one sequence"
    assert not list((tmp_path / "cup").rglob("*.tmp"))


def test_files_that_the_disk_has_cut_short_are_not_taken_for_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = frame_files.save_array

    def cut_short(path: Path, array: np.ndarray) -> int:
        size = whole(path, array)
        os.truncate(path, size - 100)
        return size

    monkeypatch.setattr(frame_files, "save_array", cut_short)
    with pytest.raises(InputError, match="the disk has not kept what was written"):
        run(tmp_path / "cup", captures(2))
    monkeypatch.undo()
    assert run(tmp_path / "cup", captures(2)).manifest["sequences"]["kept"] == 2


def test_the_square_follows_the_object_but_stays_inside() -> None:
    camera = ring(even(1), elevation_deg=0)[0]
    image = torch.rand(3, 48, 64)
    mask = torch.zeros(48, 64)
    mask[20:30, 34:42] = 1  # centred at u = 38: the square starts at 38 - 24
    square = object_square(View(image, camera, mask=mask), 48)
    torch.testing.assert_close(square.image, image[:, :, 14:62])
    assert square.camera.intrinsics[0, 2] == 32 - 14
    mask[:, 60:] = 1
    assert object_square(View(image, camera, mask=mask), 48).camera.intrinsics[0, 2] == 32 - 16


def test_the_split_file_names_the_test_sequences(tmp_path: Path) -> None:
    run(tmp_path / "cup", captures(4), test_names={"0002"})
    split = json.loads((tmp_path / "cup" / "split.json").read_text())
    assert split["test"] == ["cup/0002"]
    assert len(split["sha256"]) == 64


def test_finer_depths_are_reduced_to_one_of_their_own() -> None:
    depth = torch.zeros(4, 6)
    depth[:2, :2] = torch.tensor([[1.0, 5.0], [5.0, 5.0]])  # an edge: no depth between 1 and 5
    depth[0, 2] = 7.0  # one of four known
    depth[2:, 4:] = float("nan")
    depth[2:, :2] = torch.tensor([[2.0, float("inf")], [3.0, 4.0]])
    assert block_median(depth, 2).tolist() == [[5, 7, 0], [3, 0, 0]]
    assert block_median(depth, 1)[0].tolist() == [1, 5, 7, 0, 0, 0]


def test_a_lone_sequence_shows_how_far_its_pairs_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("extrap_train.terminal.LINE_EVERY_S", 0.0)
    sequences = [textured_capture("one", count=9, size=32)]
    options = replace(OPTIONS, max_gap_deg=60.0, max_uses=2)
    data = prepare(
        sequences,
        DatasetDepth(),
        options,
        test_names=1,
        folder=tmp_path / "cup",
        matcher=FlowMatcherConfig(),
    )
    said = capsys.readouterr().err
    pairs = sum(data.manifest["pairs"].values())
    assert f"correcting: {pairs}/{pairs} pairs" in said
    assert "preparing: 1/1 sequences" in said


def test_photographs_too_close_together_make_no_pair(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="make a training pair"):
        run(tmp_path / "cup", [capture(ring(even(9, 6)))])


class Fatal:
    """A launcher whose first job never comes back."""

    def run(self, job, items):
        yield 0, Died("its process was killed")
        yield from ((index, job(items[index])) for index in range(1, len(items)))


def test_a_sequence_whose_process_died_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    arguments = {"test_names": 1, "folder": tmp_path / "cup", "progress": False}
    data = prepare(captures(3), DatasetDepth(), OPTIONS, launcher=Fatal(), **arguments)
    reason = data.sequences.set_index("sequence").loc["cup/0000", "reason"]
    assert reason == "sequence cup/0000: its process was killed"
    assert f"left out: {reason}" in caplog.text


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory"),
        MemoryError("Unable to allocate 3 GiB"),
        RuntimeError("[enforce fail] . DefaultCPUAllocator: can't allocate memory: you tried"),
    ],
)
def test_no_memory_is_the_launchers_to_try_again_not_the_sequences_fault(
    error: Exception, tmp_path: Path
) -> None:
    @dataclass(frozen=True)
    class Greedy(DatasetDepth):
        def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
            raise error

    shop = PrepContext(PrepModels(Greedy(), None), OPTIONS, tmp_path, tmp_path)
    with pytest.raises(MemoryError, match=re.escape(str(error))):
        prepare_sequence(SequenceJob(shop, captures(1)[0], "train", "key"))
