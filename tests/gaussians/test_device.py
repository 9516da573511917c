"""Fits on the rasteriser's device: whole ones on a second device that `elsewhere.py` stands in for,
with a stand-in for gsplat; with gsplat itself where there is CUDA.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import pytest
import torch
from elsewhere import DEVICE, TwoDevices
from torch import Tensor

from benchmarks.methods.base import SceneInputs
from benchmarks.methods.dngaussian import DnGaussian
from benchmarks.methods.fsgs import Fsgs
from benchmarks.methods.instantsplat import InstantSplat
from benchmarks.methods.threedgs import ThreeDgs
from extrap_train.depth import DatasetDepth, DepthMap
from extrap_train.gaussians import recipe
from extrap_train.gaussians.fit import Fit
from extrap_train.gaussians.gaussian_model import Gaussians
from extrap_train.gaussians.gaussian_options import RASTERIZERS
from extrap_train.gaussians.rasterize import rasterization
from extrap_train.gaussians.recipe import Recipe
from extrap_train.metrics import psnr
from extrap_train.views import View
from tests.benchmarks.analytic import scene_inputs

START = 150
SMALL: dict[str, Any] = {
    "iterations": 12,
    "full_iterations": 120,
    "init_points": START,
    "max_gaussians": 240,
}
GROWING = SMALL | {"densify_from": 0, "densify_gradient": 1e-6, "reset_first": 100}
METHODS: dict[str, ThreeDgs] = {
    "3dgs": ThreeDgs(**GROWING),
    "3dgs, dense, white": ThreeDgs(**GROWING, init="dense", background="white"),
    "fsgs": Fsgs(**GROWING, unpool_proximity=1e-4, unpool_scale=0.0),
    "dngaussian": DnGaussian(
        **GROWING | {"densify_least_opacity": 0.0}, hash_levels=4, hash_log2_size=10,
    ),
    "instantsplat": InstantSplat(**SMALL),
}  # fmt: skip


def _stand_in(**arguments: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Our rasteriser behind gsplat's door: takes tensors of the other device alone."""
    tensors = {name: each for name, each in arguments.items() if isinstance(each, Tensor)}
    assert {each.device.type for each in tensors.values()} == {DEVICE}
    here = {name: each.to("cpu") for name, each in tensors.items()}
    values, alphas, found = rasterization(**arguments | here)
    centers = found["means2d"].detach().to(DEVICE)
    if found["means2d"].requires_grad:
        centers.requires_grad_()
        found["means2d"].register_hook(lambda grad: setattr(centers, "grad", grad.to(DEVICE)))
    seen = {"means2d": centers, "radii": found["radii"].to(DEVICE)}
    return values.to(DEVICE), alphas.to(DEVICE), seen


@pytest.fixture
def two_devices(monkeypatch: pytest.MonkeyPatch) -> TwoDevices:
    """With `rasterizer=gsplat` on the second of them."""
    monkeypatch.setitem(RASTERIZERS, "gsplat", DEVICE)
    drawn_by = {"numba": rasterization, "gsplat": _stand_in}
    monkeypatch.setattr(recipe, "rasterizer", drawn_by.__getitem__)
    adam = import_module("torch.optim.optimizer")  # has one kernel for all, but not on every device
    monkeypatch.setattr(adam, "_get_fused_kernels_supported_devices", lambda: ["cpu", DEVICE])
    return TwoDevices()


def test_the_second_device_computes_and_refuses_what_cuda_refuses() -> None:
    with TwoDevices():
        there = torch.arange(3.0).to(DEVICE)
        assert there.device.type == there.new_zeros(2).device.type == DEVICE
        assert (2 * there).cpu().tolist() == [0, 2, 4]
        with pytest.raises(RuntimeError, match="tensors on the CPU and on"):
            there + torch.ones(3)
        with pytest.raises(RuntimeError, match="tensors on the CPU and on"):
            torch.stack([there[0], torch.tensor(1.0)])
        with pytest.raises(RuntimeError, match="random numbers are drawn on the CPU"):
            torch.randn(3, device=DEVICE)
        with pytest.raises(RuntimeError):
            there.numpy()


@dataclass(frozen=True)
class _Made:
    """What a fit gives away."""

    image: Tensor
    gaussians: Gaussians
    fit: Fit


def _both(two_devices: TwoDevices, method: ThreeDgs, inputs: SceneInputs) -> tuple[_Made, _Made]:
    """On the CPU and on the other device. Both within the mode: PyTorch multiplies matrices in
    another order, with other last bits, where a mode is on.
    """
    made = []
    with two_devices:
        for each in (method, replace(method, rasterizer="gsplat")):
            fitted = each.fit_scene(inputs)
            made.append(_Made(fitted.render(inputs.targets), fitted.gaussians(), fitted))
    return made[0], made[1]


@pytest.mark.parametrize("name", METHODS)
def test_a_fit_elsewhere_is_the_fit_on_the_cpu(two_devices: TwoDevices, name: str) -> None:
    """All that training does happens there, what comes back is on the CPU, and no bit differs."""
    here, there = _both(two_devices, METHODS[name], scene_inputs(size=24)[0])
    devices = {each.device.type for each in there.fit.parameters.tensors().values()}
    assert devices == {DEVICE}
    assert type(there.image) is Tensor
    assert there.image.equal(here.image)
    for field, value in vars(here.gaussians).items():
        assert type(getattr(there.gaussians, field)) is Tensor
        assert getattr(there.gaussians, field).equal(value), field
    assert there.fit.record == here.fit.record
    if METHODS[name].densify_until:
        assert len(there.gaussians) > START


@dataclass(frozen=True)
class _Network(DatasetDepth):
    """A depth source that can look at drawings, and reads what it is shown on the CPU."""

    @property
    def image_size(self) -> int:  # type: ignore[override]
        return 24

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        brightness = torch.from_numpy(view.image.numpy().mean(0))
        near = torch.from_numpy(view.camera.world_to_cam.numpy()[2, 3:])
        return DepthMap(brightness + near, torch.ones_like(brightness))


def test_pseudo_views_go_to_the_cpu_and_their_depth_comes_back(two_devices: TwoDevices) -> None:
    inputs = replace(scene_inputs(size=24)[0], depth_source=_Network())
    method = Fsgs(**SMALL, pseudo_from=0, pseudo_every=2, monocular="depth_source")
    here, there = _both(two_devices, method, inputs)
    assert there.fit.record["pseudo views"] == "yes"
    assert there.image.equal(here.image)


def test_a_camera_that_was_left_behind_is_seen(
    two_devices: TwoDevices, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The counterpart: the tests above would fail where something is not moved."""
    monkeypatch.setattr(Recipe, "camera", lambda self, index: self.scene.views[index].camera)
    inputs, _ = scene_inputs(size=24)
    with two_devices, pytest.raises(AssertionError):
        replace(METHODS["3dgs"], rasterizer="gsplat").fit_scene(inputs)


@pytest.mark.gpu
@pytest.mark.parametrize("name", METHODS)
def test_gsplat_learns_as_much(name: str) -> None:
    """Not bit by bit: its sums have no fixed order."""
    pytest.importorskip("gsplat")
    inputs, truth = scene_inputs(size=24)
    here = METHODS[name].fit_scene(inputs)
    there = replace(METHODS[name], rasterizer="gsplat").fit_scene(inputs)
    assert {each.device.type for each in there.parameters.tensors().values()} == {"cuda"}
    scores = [float(psnr(each.render(inputs.targets), truth).mean()) for each in (here, there)]
    assert scores[1] == pytest.approx(scores[0], abs=1)
