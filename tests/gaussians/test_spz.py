"""SPZ files hold the Gaussians of the PLY file, as the library reads them back."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.nn import functional

from extrap_train.errors import InputError
from extrap_train.gaussians import spz
from extrap_train.gaussians.gaussian_model import Gaussians
from extrap_train.gaussians.ply import write_splats


def _gaussians(unit: float) -> Gaussians:
    random = torch.Generator().manual_seed(0)
    quats = functional.normalize(torch.randn(50, 4, generator=random), dim=-1)
    return Gaussians(
        means=unit * torch.randn(50, 3, generator=random),
        quats=quats,
        scales=0.01 + torch.rand(50, 3, generator=random),
        opacities=0.05 + 0.9 * torch.rand(50, generator=random),
        sh=0.5 * torch.rand(50, 16, 3, generator=random),
    )


@pytest.mark.parametrize("unit", [1e-2, 1.0, 1e4])
def test_they_are_read_back_within_the_formats_steps(tmp_path: Path, unit: float) -> None:
    gsply = pytest.importorskip("gsply", reason="needs gsply: the extra `spz`")
    written = _gaussians(unit)
    write_splats(tmp_path / "a.ply", written)
    spz.write_spz(tmp_path / "a.ply", tmp_path / "a.spz")
    read = gsply.read_spz(tmp_path / "a.spz")
    means, quats, logits = map(torch.from_numpy, (read.means, read.quats, read.opacities))
    farthest = max(float(written.means.abs().max()), 0.5)
    assert (means - written.means).abs().max() <= 2**-22 * farthest
    assert ((quats * written.quats).sum(1).abs() > 0.9999).all()  # q and −q are one rotation
    assert torch.allclose(logits.flatten().sigmoid(), written.opacities, atol=0.5 / 255 + 1e-4)
    assert torch.allclose(torch.from_numpy(read.scales), written.scales.log(), atol=0.5 / 16)
    dc, rest = torch.from_numpy(read.sh0), torch.from_numpy(read.shN)
    assert torch.allclose(dc, written.sh[:, 0], atol=0.5 / (0.15 * 255) + 1e-4)
    assert torch.allclose(rest, written.sh[:, 1:], atol=0.5 / 128 + 1e-4)


@pytest.mark.parametrize(("widest", "warns"), [(1e-6, True), (1e-3, False), (1e3, True)])
def test_sizes_that_the_format_cannot_hold_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog, widest: float, warns: bool
) -> None:
    scales = np.log(np.array([[1e-9, 1e-9, widest]] * 9, np.float32))  # flat: thin everywhere
    splats = SimpleNamespace(means=np.zeros((9, 3), np.float32), scales=scales)
    library = SimpleNamespace(
        plyread=lambda _: splats, write_spz=lambda path, *_, **__: Path(path).write_bytes(b"spz")
    )
    monkeypatch.setitem(sys.modules, "gsply", library)
    spz.write_spz(tmp_path / "a.ply", tmp_path / "a.spz")
    assert ("splats.ply" in caplog.text) == warns


def test_it_is_refused_at_the_door_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spz, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"complete\.splats\.spz.*extrap-train\[spz\]"):
        spz.require_gsply()
