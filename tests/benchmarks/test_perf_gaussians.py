"""The timed rasteriser draws and differentiates what its plain reference does."""

import pytest
import torch

from benchmarks.perf.gaussians_timing import cube_of_gaussians, rasterize_reference
from benchmarks.perf.timing import compare
from benchmarks.perf.warp_timing import orbit_camera
from extrap_train.errors import InputError
from extrap_train.gaussians.rasterize import rasterizer

SIZE = 40


def test_reference_is_equal():
    inputs = [x.requires_grad_() for x in cube_of_gaussians(120)]
    camera = orbit_camera(20.0, SIZE)
    poses = (camera.world_to_cam[None], camera.intrinsics[None])
    image = rasterizer("numba")(*inputs, *poses, SIZE, SIZE)[0][0]
    reference = rasterize_reference(camera, *inputs)
    assert torch.allclose(image, reference, atol=2e-4)  # full pixels go on in the reference
    weight = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    ours = torch.autograd.grad((image * weight).sum(), inputs)
    theirs = torch.autograd.grad((reference * weight).sum(), inputs)
    for a, b in zip(ours, theirs, strict=True):
        assert (a - b).abs().max() < 1e-3 * b.abs().max()


@pytest.mark.skipif(torch.cuda.is_available(), reason="says what is missing without a GPU")
def test_gsplat_without_a_gpu_is_one_line():
    with pytest.raises(InputError, match="rasterizer=numba"):
        rasterizer("gsplat")


@pytest.mark.gpu
def test_gsplat_is_equal():
    pytest.importorskip("gsplat")
    inputs = [x.requires_grad_() for x in cube_of_gaussians(500)]
    camera = orbit_camera(20.0, SIZE)
    results = []
    for name, device in (("numba", "cpu"), ("gsplat", "cuda")):
        poses = (camera.world_to_cam[None].to(device), camera.intrinsics[None].to(device))
        arguments = (*(x.to(device) for x in inputs), *poses, SIZE, SIZE)
        image, alpha, _ = rasterizer(name)(*arguments, render_mode="RGB+ED")
        drawn = torch.cat([image, alpha], -1).cpu()
        results.append([drawn, *torch.autograd.grad(drawn.square().sum(), inputs)])
    for a, b in zip(*results, strict=True):
        assert (a - b).abs().max() < 1e-3 * b.abs().max()


def test_each_row_is_told_as_it_is_measured(capsys: pytest.CaptureFixture[str]):
    seen: list[str] = []

    def other() -> torch.Tensor:
        seen.append(capsys.readouterr().err)
        return torch.ones(2)

    compare("first", torch.device("cpu"), lambda: torch.ones(2), other, repeats=1)
    compare("second", torch.device("cpu"), lambda: torch.ones(2), other, repeats=1)
    assert any(line.startswith("first, cpu: ") and "reference" in line for line in seen)
