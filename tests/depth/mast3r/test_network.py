import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file
from tiny import TINY, tiny_state, write_checkpoint

from extrap_train.depth.mast3r.network.mast3r_checkpoint import read_network
from extrap_train.depth.mast3r.network.point_map_network import Architecture, PointMapNetwork

SMALL = replace(TINY, decoder_depth=4)


@torch.no_grad()
def test_outputs_are_the_published_networks(shared, tmp_path):
    network = read_network(write_checkpoint(tiny_state(shared), tmp_path / "tiny.pth"))
    expected = load_file(shared / "fixtures" / "mast3r_tiny" / "expected.safetensors")
    predictions = network(expected["image1"], expected["image2"])
    points = ("view1.pts3d", "view2.pts3d_in_other_view")
    for view, name, found in zip(("view1", "view2"), points, predictions, strict=True):
        distance = (found.points - expected[name]).norm(dim=-1)
        assert (distance <= 1e-4 * expected[name].norm(dim=-1)).all()
        assert float(distance.norm() / expected[name].norm()) < 1e-4
        truth = expected[f"{view}.conf"]
        # 1 + exp(x): what rounding does to x grows with the confidence.
        assert torch.allclose(found.confidence, truth, rtol=1e-4, atol=0)


@torch.no_grad()
def test_descriptors_are_the_published_networks(shared, tmp_path):
    network = read_network(write_checkpoint(tiny_state(shared), tmp_path / "tiny.pth"))
    expected = load_file(shared / "fixtures" / "mast3r_tiny" / "expected.safetensors")
    both = network.describe(*(network.encode(expected[f"image{i}"]) for i in (1, 2)))
    for view, found in zip(("view1", "view2"), both, strict=True):
        assert torch.allclose(found.descriptors, expected[f"{view}.desc"], atol=1e-4)
        assert torch.allclose(found.confidence, expected[f"{view}.desc_conf"], rtol=1e-3)


def test_names_and_shapes_are_the_published_ones(shared):
    layout = json.loads((shared / "layouts" / "mast3r.json").read_text())["keys"]
    with torch.device("meta"):
        network = PointMapNetwork(Architecture())
    assert {name: list(x.shape) for name, x in network.state_dict().items()} == layout
    strict = {name: torch.empty(shape, device="meta") for name, shape in layout.items()}
    network.load_state_dict(strict, strict=True, assign=True)


@pytest.mark.parametrize("size", [(48, 80), (32, 16)])
@pytest.mark.parametrize(
    "architecture",
    [SMALL, replace(SMALL, descriptor_width=None), replace(SMALL, head="linear")],
    ids=["mast3r", "dust3r", "dust3r linear"],
)
@torch.no_grad()
def test_every_shape_of_picture_gives_every_pixel_a_point(architecture, size):
    torch.manual_seed(0)
    network = PointMapNetwork(architecture).eval()
    first, second = torch.rand(2, 1, 3, *size)
    for prediction in network(first, second):
        assert prediction.points.shape == (1, *size, 3)
        assert prediction.points.isfinite().all()
        assert (prediction.confidence >= 1).all()


@torch.no_grad()
def test_pictures_of_different_size_and_the_batch_do_not_mix():
    torch.manual_seed(0)
    network = PointMapNetwork(SMALL).eval()
    firsts, seconds = torch.rand(2, 3, 32, 48), torch.rand(2, 3, 48, 32)
    together = network(firsts, seconds)
    apart = network(firsts[1:], seconds[1:])
    for both, one in zip(together, apart, strict=True):
        torch.testing.assert_close(both.points[1:], one.points, atol=1e-4, rtol=1e-4)
