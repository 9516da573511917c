"""Metrics equal independent implementations and are fed the range that they declare."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure

from extrap_train.errors import InputError
from extrap_train.metrics import (
    dists_distance,
    lpips_distance,
    psnr,
    quantised,
    require_unit_range,
    squeeze_lpips,
    ssim,
)


@pytest.fixture
def images() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(3, 3, 32, 32, generator=generator)
    noise = torch.randn(3, 3, 32, 32, generator=generator)
    return (truth + 0.1 * noise).clamp(0, 1), truth


def test_psnr_is_scikit_images(images: tuple[torch.Tensor, torch.Tensor]) -> None:
    pairs = zip(*(i.numpy() for i in images), strict=True)
    expected = [peak_signal_noise_ratio(t, p, data_range=1.0) for p, t in pairs]
    np.testing.assert_allclose(psnr(*images), expected, atol=1e-4)


def test_masked_psnr_sees_only_the_mask(images: tuple[torch.Tensor, torch.Tensor]) -> None:
    prediction, truth = images
    mask = torch.zeros(3, 32, 32)
    mask[:, :10] = 1
    inside = psnr(prediction[..., :10, :], truth[..., :10, :])
    torch.testing.assert_close(psnr(prediction, truth, mask), inside)
    assert psnr(prediction, truth, torch.zeros_like(mask)).isnan().all()


def test_ssim_agrees_with_another_library(images: tuple[torch.Tensor, torch.Tensor]) -> None:
    """torchmetrics pads differently: only the inside is the same, hence a mean within a percent."""
    other = structural_similarity_index_measure(*images, data_range=1.0, reduction="none")
    torch.testing.assert_close(ssim(*images), other, atol=0.01, rtol=0)


def test_quantising_is_what_a_file_does(tmp_path: Path) -> None:
    image = torch.rand(1, 3, 8, 8) * 1.2 - 0.1
    pixels = (quantised(image)[0].permute(1, 2, 0) * 255).round().byte().numpy()
    Image.fromarray(pixels).save(tmp_path / "x.png")
    back = torch.from_numpy(np.array(Image.open(tmp_path / "x.png"))).float() / 255
    torch.testing.assert_close(back.permute(2, 0, 1)[None], quantised(image))


def test_lpips_gives_the_published_distances(shared: Path) -> None:
    folder = shared / "weights"
    distance = squeeze_lpips(str(folder / "lpips_squeeze.pt"))

    def load(name: str) -> torch.Tensor:
        pixels = np.asarray(Image.open(folder / name).convert("RGB"))
        return torch.from_numpy(pixels.copy()).permute(2, 0, 1)[None].float() / 255

    reference = load("ex_ref.png")
    assert float(distance(load("ex_p0.png"), reference)) == pytest.approx(0.7110, abs=2e-4)
    assert float(distance(load("ex_p1.png"), reference)) == pytest.approx(0.1479, abs=2e-4)


def test_missing_lpips_weights_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(InputError, match=r"validation\.lpips_weights"):
        squeeze_lpips(None)
    with pytest.raises(InputError, match=r"no\.pt"):
        squeeze_lpips(str(tmp_path / "no.pt"))
    (tmp_path / "bad.pt").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"bad\.pt"):
        squeeze_lpips(str(tmp_path / "bad.pt"))
    torch.save({"net.slice1.0.weight": torch.zeros(1)}, tmp_path / "other.pt")
    with pytest.raises(InputError, match=r"other\.pt: is another network"):
        squeeze_lpips(str(tmp_path / "other.pt"))


def test_masked_ssim_is_the_maps_mean_in_the_mask(
    images: tuple[torch.Tensor, torch.Tensor],
) -> None:
    """Against scikit-image's own map; the mask of everything but a border is the plain value."""
    prediction, truth = images
    mask = torch.zeros(3, 32, 32)
    mask[:, 4:9, 7:20] = 1
    expected = []
    for p, t in zip(prediction.double().numpy(), truth.double().numpy(), strict=True):
        _, similarity = structural_similarity(
            p, t, channel_axis=0, data_range=1.0, gaussian_weights=True, sigma=1.5,
            use_sample_covariance=False, full=True,
        )  # fmt: skip
        expected.append(similarity[:, 4:9, 7:20].mean())
    np.testing.assert_allclose(ssim(prediction, truth, mask), expected, atol=1e-6)
    inside = torch.zeros(3, 32, 32)
    inside[:, 5:-5, 5:-5] = 1
    torch.testing.assert_close(ssim(prediction, truth, inside), ssim(prediction, truth))
    assert ssim(prediction, truth, torch.zeros_like(mask)).isnan().all()


def test_identical_images_score_perfectly(images: tuple[torch.Tensor, torch.Tensor]) -> None:
    _, truth = images
    assert (psnr(truth, truth) >= 100).all()
    torch.testing.assert_close(ssim(truth, truth), torch.ones(3))


@pytest.mark.parametrize("scale", [lambda x: 2 * x - 1, lambda x: 255 * x, lambda x: x * torch.nan])
def test_other_ranges_are_refused(scale, images: tuple[torch.Tensor, torch.Tensor]) -> None:
    require_unit_range(images[1])
    with pytest.raises(ValueError, match=r"metrics take images in \[0, 1\]"):
        require_unit_range(scale(images[1]))


@pytest.mark.parametrize("net", ["alex", "vgg", "squeeze"])
def test_every_missing_backbone_is_named(
    net: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(InputError, match=rf"LPIPS \({net}\).*option\.{net}=FILE"):
        lpips_distance(net, None, f"option.{net}")
    with pytest.raises(InputError, match="vgg16-397923af"):
        dists_distance()


def test_dists_is_torchmetrics_with_what_lies_in_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, images: tuple[torch.Tensor, torch.Tensor]
) -> None:
    """Random VGG weights in the cache: the distance is that of torchmetrics' public function."""
    from torchmetrics.functional.image.dists import deep_image_structure_and_texture_similarity
    from torchvision.models import vgg16

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *_, **__: state)
    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", lambda *_, **__: state)
    torch.manual_seed(0)
    state = vgg16(weights=None).state_dict()
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    (tmp_path / "hub" / "checkpoints" / "vgg16-397923af.pth").touch()
    prediction, truth = images
    distance = dists_distance()
    expected = deep_image_structure_and_texture_similarity(prediction, truth)
    torch.testing.assert_close(distance(prediction, truth), expected.detach().flatten())
    torch.testing.assert_close(distance(truth, truth), torch.zeros(3), atol=1e-5, rtol=0)
