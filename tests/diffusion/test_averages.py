"""Snapshots of averages stay few, whatever happens on the way, and still make the other widths."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from lightning import LightningModule, Trainer

from extrap_train.config import ModelConfig, TrainerConfig
from extrap_train.diffusion.averages import (
    MOST_SNAPSHOTS,
    TRACKED_WIDTHS,
    PowerAverages,
    snapshot_bytes,
    thinned,
)
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.power_average import Profile, exponent_of, mixture


def _run(callback: PowerAverages, steps: range) -> None:
    """The ends of epochs, without the training between them."""
    for step in steps:
        trainer = Mock(spec=Trainer, is_global_zero=True, global_step=step)
        callback.on_train_epoch_end(trainer, Mock(spec=LightningModule))


def _kept(folder: Path) -> list[int]:
    return sorted(int(file.stem.split("-")[1]) for file in folder.glob("step-*.safetensors"))


def test_a_long_run_keeps_few_snapshots_and_a_killed_one_the_same(tmp_path: Path) -> None:
    seen = []
    callback = PowerAverages(tmp_path / "whole", every=100)
    callback.averages = {"0.05": {"w": torch.ones(3)}}
    for step in range(100, 7001, 100):
        _run(callback, range(step, step + 1))
        seen.append(len(_kept(tmp_path / "whole")))
    assert max(seen) == MOST_SNAPSHOTS
    assert min(seen[MOST_SNAPSHOTS:]) >= MOST_SNAPSHOTS // 2 + 1
    killed = PowerAverages(tmp_path / "killed", every=100)
    killed.averages = callback.averages
    _run(killed, range(100, 3301, 100))
    _run(killed, range(3300, 7001, 100))
    assert _kept(tmp_path / "killed") == _kept(tmp_path / "whole")
    assert _kept(tmp_path / "whole")[-1] == 7000


def test_a_prolonged_run_forgets_where_the_shorter_ended() -> None:
    assert thinned([100, 200, 250], 100) == [100, 200, 250]
    assert thinned([100, 200, 250, 300], 100) == [100, 200, 300]


def test_the_disk_that_is_announced_is_what_snapshots_take(
    config: ModelConfig, tmp_path: Path
) -> None:
    model = ExtrapolationModel(config)
    callback = PowerAverages(tmp_path, every=10)
    values = {name: x.detach() for name, x in model.named_parameters()}
    callback.averages = {str(width): values for width in TRACKED_WIDTHS}
    _run(callback, range(10, 31, 10))
    taken = sum(file.stat().st_size for file in tmp_path.iterdir())
    options = TrainerConfig(power_averages=True, steps=30, checkpoint_every=10)
    assert snapshot_bytes(model, options) == pytest.approx(taken, rel=0.1)
    long = replace(options, steps=10**6)
    assert snapshot_bytes(model, long) * 3 == snapshot_bytes(model, options) * 17
    assert snapshot_bytes(model, replace(long, power_averages=False)) == 0


@pytest.mark.parametrize("newest", [16, 17, 18, 33, 65])
def test_few_snapshots_make_the_other_widths(newest: int) -> None:
    """Against the profile itself on a grid of times; the error is relative, in the mean square."""
    time = (torch.arange(40_000, dtype=torch.float64) + 0.5) / 40_000

    def drawn(profile: Profile) -> torch.Tensor:
        end = profile.step / newest
        height = (profile.exponent + 1) / end
        return torch.where(time < end, height * (time / end) ** profile.exponent, 0.0)

    steps = thinned(range(1, newest + 1), 1)
    profiles = [Profile(s, exponent_of(w)) for s in steps for w in TRACKED_WIDTHS]
    for width, bound in ((0.03, 0.09), (0.07, 0.013), (0.15, 0.033), (0.2, 0.077)):
        wanted = Profile(newest, exponent_of(width))
        shares = mixture(profiles, wanted)
        made = sum(share * drawn(profile) for share, profile in zip(shares, profiles, strict=True))
        assert float((made - drawn(wanted)).norm() / drawn(wanted).norm()) < bound
