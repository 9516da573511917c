"""A GPU computes what the CPU computes: geometry, networks, pictures.

Sums are added in another order. Tolerances are a hundredfold of single precision's rounding; where
a decision hangs on a rounding, such as which pixel a point falls in, a share of pixels may differ.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusion.batches import batch_of, camera_at, random_model
from torch import Tensor

from benchmarks.perf import diffusion_case
from benchmarks.perf.warp_timing import bumpy_views, orbit_camera
from extrap_train.config import ModelConfig, SamplerConfig, UNetConfig
from extrap_train.data.examples import Example, collate, pack
from extrap_train.data.frame_files import SealedTable, SequenceFrames, StoredFrames, write_frames
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sample_views
from extrap_train.diffusion.step_noise import StepNoise
from extrap_train.geometry.warp import compute_warp, splat_points
from extrap_train.geometry.warp.surface import normals_from_depth
from extrap_train.views import PairBatch, stack_cameras

pytestmark = [pytest.mark.gpu, pytest.mark.usefixtures("exact")]
SIZE = 128


def differing(here: Tensor, there: Tensor, tolerance: float) -> float:
    """The share of numbers further apart than so much of the largest."""
    assert here.device.type == "cpu"
    apart = (here - there.cpu()).abs() > tolerance * here.abs().max()
    return float(apart.float().mean())


def unwarped(size: int = SIZE) -> PairBatch:
    return replace(batch_of(2, size), warp=None)


def test_warps_of_three_references(gpu: torch.device) -> None:
    here, there = compute_warp(unwarped()).warp, compute_warp(unwarped().to(gpu)).warp
    assert here is not None
    assert there is not None
    assert float(here.mask.mean()) > 0.3
    for name, value in vars(here).items():
        assert getattr(there, name).device.type == gpu.type
        assert differing(value, getattr(there, name), 1e-3) < 0.005, name


def test_clouds_that_are_drawn(gpu: torch.device) -> None:
    points, values = bumpy_views(SIZE)
    query = orbit_camera(15.0, SIZE)
    here = splat_points(points, values, query)
    there = splat_points(points.to(gpu), values.to(gpu), query.to(gpu))
    assert differing(here, there, 1e-3) < 0.005


def test_normals(gpu: torch.device) -> None:
    batch = unwarped()
    depth, camera = batch.reference_depths[:, 0], batch.reference_cameras[:, 0]
    here, known = normals_from_depth(depth, camera)
    there, known_there = normals_from_depth(depth.to(gpu), camera.to(gpu))
    assert float((known != known_there.cpu()).float().mean()) < 0.005
    both = known & known_there.cpu()
    assert differing(here[both], there.cpu()[both], 1e-3) < 0.005


def test_batches_on_their_way(gpu: torch.device, tmp_path: Path) -> None:
    """Read from the store, pinned, sent and unpacked: the numbers of the CPU to the bit."""
    rng = np.random.default_rng(0)
    camera = stack_cameras([camera_at(0.1 * i, SIZE) for i in range(4)])
    images = rng.integers(0, 255, (4, SIZE, SIZE, 3), np.uint8)
    depths = rng.uniform(1, 9, (4, SIZE, SIZE)).astype(np.float32)
    place = SealedTable(tmp_path / "one" / "frames.parquet", "key")
    write_frames(place, SequenceFrames(tuple("abcd"), camera, images, depths, images[..., 0]))
    table = place.read()
    assert table is not None
    stored = StoredFrames(place.file.parent, table, SIZE)
    views = [stored.view(i) for i in range(4)]
    packed = Example(
        stored.image(0),
        camera[0],
        torch.stack([stored.image(i) for i in (1, 2, 3)]),
        camera[1:],
        torch.stack([stored.depth(i) for i in (1, 2, 3)]),
        depth_unit=stored.depth_scale,
    )
    references = torch.stack([view.image for view in views[1:]])
    known = torch.stack([view.depth for view in views[1:]])
    here = collate([Example(views[0].image, camera[0], references, camera[1:], known)], 3)
    there = pack([packed], 3).pin_memory().to(gpu).unpack()
    for name in ("image", "reference_images", "reference_depths", "reference_valid"):
        assert torch.equal(getattr(here, name), getattr(there, name).cpu()), name


@pytest.fixture(scope="module")
def full_make() -> ExtrapolationModel:
    """The full size's make at 0.1 of its width: VAE, CLIP and a denoiser with its attention."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diffusion_case, "IMAGE_SIZE", 64)
        config = diffusion_case.configuration(32)
    return diffusion_case.optimised(config, torch.device("cpu")).eval()


def test_latents_and_pictures_of_the_vae(full_make: ExtrapolationModel, gpu: torch.device) -> None:
    image = batch_of(2, 64).image
    latent = full_make.autoencoder.encode(image)
    assert differing(latent, full_make.autoencoder.encode(image.to(gpu)), 1e-4) == 0
    shown = full_make.autoencoder.decode(latent)
    assert differing(shown, full_make.autoencoder.decode(latent.to(gpu)), 1e-4) == 0


def test_embeddings_of_clip(full_make: ExtrapolationModel, gpu: torch.device) -> None:
    image = batch_of(2, 64).image
    here = full_make.image_encoder(image)
    assert differing(here, full_make.image_encoder(image.to(gpu)), 1e-4) == 0


@pytest.mark.parametrize("family", ["ours", "zeronvs", "megascenes"])
def test_losses_and_gradients_of_every_family(family: str, gpu: torch.device) -> None:
    unet = UNetConfig(channels=[16, 32], attention_levels=[False, True], heads=2, token_width=16)
    model = random_model(
        ModelConfig(name="tiny", family=family, image_size=32, octaves=2, unet=unet)
    )
    batch = batch_of(2, 32, references=1)
    found = []
    for device in (torch.device("cpu"), gpu):
        model = model.to(device)
        model.zero_grad()
        loss = diffusion_loss(
            model, batch.to(device), StepNoise(torch.Generator().manual_seed(0)), 0.1
        )
        loss.backward()
        slopes = [x.grad.flatten() for x in model.parameters() if x.grad is not None]
        found.append((loss.detach().cpu(), torch.cat(slopes).cpu()))
    torch.testing.assert_close(found[0][0], found[1][0], rtol=1e-4, atol=1e-6)
    assert differing(found[0][1], found[1][1], 1e-3) == 0


def test_sampled_views(full_make: ExtrapolationModel, gpu: torch.device) -> None:
    """Noise is drawn on the CPU, so that the device does not change the picture."""
    batch, names = batch_of(2, 64), ["one", "two"]
    options = SamplerConfig(steps=3, guidance=2.0)
    here = sample_views(full_make, batch, options, names)
    there = sample_views(full_make.to(gpu), batch.to(gpu), options, names)
    full_make.to("cpu")
    assert differing(here, there, 1e-2) == 0
