"""Images and gradients against a brute-force renderer in double precision."""

import brute_force
import numba
import pytest
import torch
from splats import camera_pose, pinhole, random_gaussians

from extrap_train.gaussians.gaussian_model import sh_colors
from extrap_train.gaussians.rasterize import rasterization

WIDTH, HEIGHT = 45, 38


def leaves(gaussians, pose, dtype):
    tensors = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities]
    return [x.detach().clone().to(dtype).requires_grad_() for x in (*tensors, gaussians.sh, pose)]


def draw(inputs, mode="RGB+D", degree=None, background=None):
    means, quats, scales, opacities, colors, pose = inputs
    k = pinhole(WIDTH, HEIGHT).to(means.dtype)
    return rasterization(
        means, quats, scales, opacities, colors, pose[None], k[None], WIDTH, HEIGHT,
        sh_degree=degree, backgrounds=background, render_mode=mode,
    )  # fmt: skip


def draw_brute_force(inputs, degree, background):
    means, quats, scales, opacities, sh, pose = inputs
    colors = sh_colors(sh, means, torch.inverse(pose)[:3, 3], degree)
    k = pinhole(WIDTH, HEIGHT).double()
    shape = (means, quats, scales, opacities, colors, pose, k, WIDTH, HEIGHT)
    image, alpha, depth = brute_force.rasterize(*shape, background)
    return torch.cat([image, depth[..., None], alpha[..., None]], -1)


def assert_equal_to_brute_force(gaussians, pose, degree=0, background=None):
    """Image within 1e-5, each gradient within 1e-4 of its largest entry."""
    ours, theirs = leaves(gaussians, pose, torch.float32), leaves(gaussians, pose, torch.float64)
    shade = None if background is None else background[None]
    image, alpha, _ = draw(ours, degree=degree, background=shade)
    drawn = torch.cat([image, alpha], -1)[0]
    truth = draw_brute_force(theirs, degree, None if shade is None else background.double())
    assert (drawn - truth).abs().max() < 1e-5
    weight = torch.rand(drawn.shape, generator=torch.Generator().manual_seed(5)) - 0.3
    (drawn * weight).sum().backward()
    (truth * weight.double()).sum().backward()
    for a, b in zip(ours, theirs, strict=True):
        if len(a):
            assert (a.grad - b.grad).abs().max() <= 1e-4 * b.grad.abs().max()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_random_scenes(degree):
    background = torch.tensor([0.2, 0.5, 0.9]) if degree % 2 else None
    gaussians = random_gaussians(150, degree, seed=degree)
    assert_equal_to_brute_force(gaussians, camera_pose(), degree, background)


def test_cuts_at_the_near_plane():
    """Behind the camera, at it, just before and beyond the near plane."""
    gaussians = random_gaussians(9)
    gaussians.means[:] = torch.tensor([0.02, 0.01, 0.0])
    gaussians.means[:, 2] = torch.tensor([-1, -0.01, 0, 0.009, 0.0099, 0.0101, 0.02, 0.3, 1.0])
    gaussians.scales[:7] *= 0.02
    assert_equal_to_brute_force(gaussians, torch.eye(4))


@pytest.mark.parametrize("scale", [1e-9, 1e-4, 30.0, 1e4])
def test_tiny_and_huge(scale):
    gaussians = random_gaussians(40)
    gaussians.scales[:20] = scale
    gaussians.opacities[:20] *= 0.1
    assert_equal_to_brute_force(gaussians, camera_pose())


def test_needles_and_sheets():
    gaussians = random_gaussians(60)
    gaussians.scales[:30, 0], gaussians.scales[:30, 1:] = 3.0, 1e-4
    gaussians.scales[30:, :2], gaussians.scales[30:, 2] = 1.0, 1e-5
    assert_equal_to_brute_force(gaussians, camera_pose())


def test_transparent_and_opaque():
    gaussians = random_gaussians(60)
    gaussians.opacities[:20], gaussians.opacities[20:40] = 0.0, 1.0
    gaussians.opacities[40:50] = 1 / 255 - 1e-6
    assert_equal_to_brute_force(gaussians, camera_pose())


def test_off_screen_ones_reach_in():
    gaussians = random_gaussians(80)
    gaussians.means[:, 0] *= 6
    assert_equal_to_brute_force(gaussians, camera_pose())


def test_none_at_all():
    background = torch.tensor([0.1, 0.2, 0.3])
    inputs = leaves(random_gaussians(0), camera_pose(), torch.float32)
    image, alpha, found = draw(inputs, degree=0, background=background[None])
    assert torch.equal(image[0, ..., :3], background.expand(HEIGHT, WIDTH, 3))
    assert not alpha.any()
    assert found["radii"].shape == (1, 0, 2)
    (image.sum() + alpha.sum()).backward()
    assert not inputs[5].grad.any()


def test_not_a_number_is_not_drawn():
    gaussians = random_gaussians(30)
    whole = draw(leaves(gaussians, camera_pose(), torch.float32), degree=0)[0]
    worse = random_gaussians(34)
    for field in ("means", "quats", "scales", "opacities", "sh"):
        getattr(worse, field)[:30] = getattr(gaussians, field)
    worse.means[30], worse.scales[31, 1] = torch.nan, torch.nan
    worse.opacities[32], worse.means[33, 2] = torch.nan, torch.inf
    inputs = leaves(worse, camera_pose(), torch.float32)
    image = draw(inputs, degree=0)[0]
    # With more Gaussians: vectorised kernels may round a tensor's end otherwise than its middle.
    torch.testing.assert_close(image, whole, atol=1e-5, rtol=0)
    image.sum().backward()
    assert all(x.grad.isfinite().all() for x in inputs)


def test_mean_depth_and_background_have_the_gradients_of_brute_force():
    gaussians, pose = random_gaussians(20, seed=3), camera_pose()
    ours, theirs = leaves(gaussians, pose, torch.float32), leaves(gaussians, pose, torch.float64)
    shade = torch.tensor([0.3, 0.6, 0.9])
    shades = [shade.clone().requires_grad_(), shade.double().requires_grad_()]
    image, alpha, _ = draw(ours, mode="RGB+ED", degree=0, background=shades[0][None])
    truth = draw_brute_force(theirs, 0, shades[1])
    mean = truth[..., 3:4] / truth[..., 4:].clamp(min=1e-10)
    truth = torch.cat([truth[..., :3], mean, truth[..., 4:]], -1)
    drawn = torch.cat([image, alpha], -1)[0]
    weight = torch.rand(drawn.shape, generator=torch.Generator().manual_seed(5)) - 0.3
    (drawn * weight).sum().backward()
    (truth * weight.double()).sum().backward()
    for a, b in zip([*ours, shades[0]], [*theirs, shades[1]], strict=True):
        assert (a.grad - b.grad).abs().max() <= 1e-3 * b.grad.abs().max()


@pytest.mark.slow  # compiles every kernel for double precision, which nothing else uses
def test_gradcheck_in_double_precision():
    gaussians = random_gaussians(3, degree=1, seed=3)
    inputs = leaves(gaussians, camera_pose(), torch.float64)
    background = torch.rand(1, 3, dtype=torch.float64).requires_grad_()

    def function(*tensors):
        image, alpha, _ = rasterization(
            *tensors[:5], tensors[5][None], pinhole(12, 9).double()[None], 12, 9,
            sh_degree=1, backgrounds=tensors[6], render_mode="RGB+ED",
        )  # fmt: skip
        return image, alpha

    assert torch.autograd.gradcheck(function, [*inputs, background], atol=1e-6)


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_modes_are_views_of_one_image(mode):
    inputs = leaves(random_gaussians(50), camera_pose(), torch.float32)
    background = torch.tensor([[0.3, 0.6, 0.9]])
    image, alpha, _ = draw(inputs, mode, 0, background)
    both = draw(inputs, "RGB+D", 0, background)[0]
    expected = [both[..., :3]] if "RGB" in mode else []
    if mode.endswith("ED"):
        expected.append(both[..., 3:] / alpha.clamp(min=1e-10))
    elif mode.endswith("D"):
        expected.append(both[..., 3:])
    assert torch.allclose(image, torch.cat(expected, -1), atol=1e-6)


def test_cameras_are_independent_and_screen_gradients_are_kept():
    gaussians = random_gaussians(50)
    poses = torch.stack([camera_pose(angle_rad=angle) for angle in (0.0, 0.7)])
    k = pinhole(WIDTH, HEIGHT).expand(2, 3, 3)
    inputs = leaves(gaussians, camera_pose(), torch.float32)
    image, _, found = rasterization(*inputs[:5], poses, k, WIDTH, HEIGHT, sh_degree=0)
    found["means2d"].retain_grad()
    image[1].sum().backward()
    single = draw([*inputs[:5], poses[1]], "RGB", 0)[0]
    torch.testing.assert_close(image[1], single[0], atol=1e-5, rtol=0)  # batches round otherwise
    assert found["radii"].dtype == torch.int32
    assert not found["means2d"].grad[0].any()
    drawn = (found["radii"][1] > 0).all(1)
    assert (found["means2d"].grad[1][drawn] != 0).any(1).float().mean() > 0.9


def test_colors_of_a_camera_and_many_channels():
    gaussians = random_gaussians(30)
    inputs = leaves(gaussians, camera_pose(), torch.float32)
    colors = torch.rand(1, 30, 7)
    image, _, _ = draw([*inputs[:4], colors, inputs[5]], "RGB")
    for channels in (slice(0, 3), slice(3, 7)):
        part, _, _ = draw([*inputs[:4], colors[0, :, channels], inputs[5]], "RGB")
        assert torch.allclose(image[..., channels], part, atol=1e-6)


def test_same_bits_on_any_number_of_threads():
    results = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        inputs = leaves(random_gaussians(200, 1), camera_pose(), torch.float32)
        image, _, _ = draw(inputs, "RGB+ED", 1)
        image.square().sum().backward()
        results.append([image, *(x.grad for x in inputs)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
