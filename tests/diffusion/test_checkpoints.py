"""A run resumes from a checkpoint as it was saved, or passes it over with its reason."""

import os
import random
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from extrap_train.diffusion.checkpoints import (
    WholeCheckpointIO,
    checkpoints,
    find_damage,
    newest_intact,
    restoring,
    thin_checkpoints,
)
from extrap_train.errors import InputError

_CHECKPOINT: dict[str, Any] = {
    "global_step": 5,
    "state_dict": {"weight": torch.arange(600.0)},
    "optimizer_states": [{"state": {}}],
    "lr_schedulers": [{}],
    "callbacks": {},
    "loops": {"fit_loop": {}},
}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "step-00000005.ckpt"
    WholeCheckpointIO().save_checkpoint(_CHECKPOINT, path)
    return path


def test_a_checkpoint_comes_back_as_it_was_saved(saved: Path) -> None:
    assert find_damage(saved) is None
    loaded = WholeCheckpointIO().load_checkpoint(saved)
    assert torch.equal(loaded["state_dict"]["weight"], torch.arange(600.0))


def test_a_checkpoint_is_read_where_it_is_used(tmp_path: Path) -> None:
    """Loading one of 256 MB takes no memory for its tensors."""
    path = tmp_path / "step-00000001.ckpt"
    WholeCheckpointIO().save_checkpoint({"state_dict": {"weight": torch.ones(2**26)}}, path)
    loaded = WholeCheckpointIO().load_checkpoint(path)
    before = _private_kib()
    assert float(loaded["state_dict"]["weight"][::4096].sum()) == 2**14
    assert _private_kib() - before < 2**15
    loaded["state_dict"]["weight"].zero_()
    del loaded
    assert torch.load(path, mmap=True)["state_dict"]["weight"][0] == 1, "the file stays as it was"


def _private_kib() -> int:
    """Memory of this process that no file stands for."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("RssAnon")).split()[1])


def test_no_flipped_bit_changes_what_is_loaded(saved: Path) -> None:
    """Either the file is refused, or the bit was one that means nothing."""
    content = saved.read_bytes()
    rng = random.Random(0)
    refused = 0
    for _ in range(200):
        damaged = bytearray(content)
        damaged[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        saved.write_bytes(damaged)
        if find_damage(saved) is not None:
            refused += 1
            continue
        loaded = WholeCheckpointIO().load_checkpoint(saved)
        assert torch.equal(loaded["state_dict"]["weight"], torch.arange(600.0))
        assert loaded["global_step"] == 5
    assert refused > 100


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:900])


def _flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    at = content.index(torch.arange(600.0).numpy().tobytes()[400:440])
    content[at + 5] ^= 4
    path.write_bytes(content)


class _Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return print, ("code ran",)


def _deep() -> Any:
    nested: Any = []
    for _ in range(100_000):
        nested = [nested]
    return nested


def _bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"0" * 10**6)


def _resaved(**changes: Any) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        kept = {key: value for key, value in (_CHECKPOINT | changes).items() if value is not None}
        torch.save(kept, path)

    return damage


_DAMAGES: dict[str, Callable[[Path], Any]] = {
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("no checkpoint"),
    "cut": _cut,
    "flipped": _flipped,
    "code": _resaved(callbacks={"a": _Evil()}),
    "bomb": _bomb,
    "no step": _resaved(global_step=None),
    "no loops": _resaved(loops=None),
    "no optimiser": _resaved(optimizer_states=None),
    "odd weights": _resaved(state_dict=[1]),
    "no average": _resaved(current_model_state={"a": torch.ones(1)}),
    "a list": lambda path: torch.save([1, 2], path),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("damage", _DAMAGES.values(), ids=_DAMAGES)
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before(
    saved: Path, damage: Callable[[Path], Any], capsys: pytest.CaptureFixture[str]
) -> None:
    newer = saved.with_name("step-00000010.ckpt")
    newer.write_bytes(saved.read_bytes())
    damage(newer)
    said: list[str] = []
    assert newest_intact(saved.parent, said.append) == saved
    assert len(said) == 1
    assert str(newer) in said[0]
    assert "\n" not in said[0]
    assert "code ran" not in capsys.readouterr().out


def test_without_an_intact_checkpoint_a_run_begins_again(saved: Path) -> None:
    _cut(saved)
    assert newest_intact(saved.parent, lambda _: None) is None
    assert newest_intact(saved.parent / "none", lambda _: None) is None


def test_what_only_looks_like_a_checkpoint_is_none(saved: Path) -> None:
    for name in ("step-x.ckpt", "step-.ckpt", ".step-00000009.ckpt.host-1.tmp", "step-5.txt"):
        (saved.parent / name).touch()
    assert checkpoints(saved.parent) == [saved]


@pytest.mark.parametrize("content", [_deep(), {"a": 3}, {"fit_loop": {"epoch_progress": 3}}])
def test_an_odd_checkpoint_that_has_its_entries_ends_in_one_line(
    tmp_path: Path, content: Any
) -> None:
    """What nobody can check before is named as long as training has not begun from it."""

    def restore() -> None:
        with restoring(str(tmp_path / "step-00000010.ckpt"), lambda: False):
            content["fit_loop"]["epoch_progress"]["total"]

    with pytest.raises(InputError, match=r"step-00000010\.ckpt: cannot be resumed from"):
        restore()


def test_a_fault_of_training_itself_keeps_its_name() -> None:
    with pytest.raises(KeyError), restoring("step-00000010.ckpt", lambda: True):
        raise KeyError("a bug")
    with pytest.raises(KeyError), restoring(None, lambda: False):
        raise KeyError("a bug")


def test_a_checkpoint_that_cannot_be_written_leaves_nothing(saved: Path) -> None:
    (saved.parent / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        WholeCheckpointIO().save_checkpoint({}, saved.parent / "file" / "step-00000002.ckpt")
    assert checkpoints(saved.parent) == [saved]


def test_a_checkpoint_has_its_name_only_once_it_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    were_there: list[bool] = []
    target = tmp_path / "step-00000001.ckpt"
    monkeypatch.setattr(os, "fsync", lambda _: were_there.append(target.exists()))
    WholeCheckpointIO().save_checkpoint({"a": torch.ones(2)}, target)
    assert were_there == [False, True]


@pytest.mark.parametrize("keep", [0, 1, 2, 5])
def test_a_finished_run_keeps_its_newest_checkpoints(tmp_path: Path, keep: int) -> None:
    for step in (5, 10, 15):
        (tmp_path / f"step-{step:08d}.ckpt").touch()
    there = checkpoints(tmp_path)
    thin_checkpoints(tmp_path, keep)
    assert checkpoints(tmp_path) == (there[-keep:] if keep else [])
