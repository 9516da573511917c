"""Metrics equal independent implementations and are fed the range that they declare."""

import contextlib
import hashlib
import io
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import lpips
import numpy as np
import pytest
import torch
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure
from torchvision.models import alexnet, squeezenet1_1, vgg16

from extrap_train.errors import InputError
from extrap_train.metrics import (
    BACKBONES,
    dists_distance,
    lpips_distance,
    lpips_or_reason,
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


def put_backbone(
    hub: Path, net: str, content: bytes, monkeypatch: pytest.MonkeyPatch, digest: str | None = None
) -> Path:
    """A file in torch's hub cache, named by its digest unless another is given."""
    digest = digest or hashlib.sha256(content).hexdigest()[:8]
    monkeypatch.setenv("TORCH_HOME", str(hub))
    monkeypatch.setitem(BACKBONES, net, f"{net}-{digest}.pth")
    file = hub / "hub" / "checkpoints" / BACKBONES[net]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)
    return file


def saved(content: object, **options: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer, **options)
    return buffer.getvalue()


def test_dists_is_torchmetrics_with_what_lies_in_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, images: tuple[torch.Tensor, torch.Tensor]
) -> None:
    """Random VGG weights in the cache: the distance is that of torchmetrics' public function."""
    from torchmetrics.functional.image.dists import deep_image_structure_and_texture_similarity

    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", lambda *_, **__: state)
    torch.manual_seed(0)
    state = vgg16(weights=None).state_dict()
    features = {name: x for name, x in state.items() if name.startswith("features.")}
    put_backbone(tmp_path, "vgg", saved(features), monkeypatch)
    prediction, truth = images
    distance = dists_distance()
    expected = deep_image_structure_and_texture_similarity(prediction, truth)
    torch.testing.assert_close(distance(prediction, truth), expected.detach().flatten())
    torch.testing.assert_close(distance(truth, truth), torch.zeros(3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("net", ["alex", "squeeze"])
def test_lpips_is_the_library_s_with_the_cached_backbone(
    net: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    images: tuple[torch.Tensor, torch.Tensor],
) -> None:
    """The library's own loading is the reference: torchvision gives it the same random weights."""
    torch.manual_seed(0)
    state = {"alex": alexnet, "squeeze": squeezenet1_1}[net](weights=None).state_dict()
    put_backbone(tmp_path, net, saved(state), monkeypatch)
    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", lambda *_, **__: state)
    expected = lpips.LPIPS(net=net, verbose=False)(*images, normalize=True).flatten()
    found = lpips_distance(net, None, "option")(*images)
    torch.testing.assert_close(found, expected.detach())


class Bomb:
    """Runs a command when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.target}",)


@pytest.fixture(params=["pickle", "zip", "legacy", "zip of a pickle", "pickle with a zip behind"])
def hostile(request: pytest.FixtureRequest, tmp_path: Path) -> bytes:
    """A file that runs a command in some reader; torch's hub itself unpacks zipped pickles."""
    state = {"features.0.weight": torch.zeros(1), "bomb": Bomb(tmp_path / "ran")}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("net.pth", saved(state, _use_new_zipfile_serialization=False))
    harmless = saved(squeezenet1_1(weights=None).state_dict(), _use_new_zipfile_serialization=False)
    return {
        "pickle": pickle.dumps(state),
        "zip": saved(state),
        "legacy": saved(state, _use_new_zipfile_serialization=False),
        "zip of a pickle": packed.getvalue(),
        "pickle with a zip behind": harmless + packed.getvalue(),
    }[request.param]


@pytest.mark.parametrize("renamed", [False, True])
def test_nothing_in_the_hub_cache_is_run(
    hostile: bytes, renamed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither under the published name, nor under one that promises just this content."""
    for net in ("squeeze", "vgg"):
        digest = None if renamed else BACKBONES[net].rpartition("-")[2].removesuffix(".pth")
        put_backbone(tmp_path, net, hostile, monkeypatch, digest)
    for read in (lambda: squeeze_lpips(None), dists_distance):
        with contextlib.suppress(InputError):
            read()
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("kept", [0, 1, 1000, -1])
def test_a_download_that_was_cut_off_is_a_missing_metric_with_the_reason(
    kept: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = saved(squeezenet1_1(weights=None).state_dict())
    digest = hashlib.sha256(whole).hexdigest()[:8]
    file = put_backbone(tmp_path, "squeeze", whole[:kept], monkeypatch, digest)
    distance, missing = lpips_or_reason(None)
    assert distance is None
    (reason,) = missing.values()
    assert str(file) in reason
    assert digest in reason
    assert "\n" not in reason
