"""Point maps of one pair by the network at its published size, with untrained weights."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel

from benchmarks.perf.timing import Row, compare
from extrap_train.depth.mast3r.point_map_network import Architecture, PointMapNetwork

HEIGHT, WIDTH = 384, 512
REPEATS = {"cpu": 1, "cuda": 15}
"""A pair takes seconds to minutes on a CPU."""


def run() -> list[Row]:
    """Fused attention against attention written out; on the GPU, too, where there is one."""
    torch.manual_seed(0)
    network = PointMapNetwork(Architecture()).eval().requires_grad_(False)
    pair = torch.rand(2, 1, 3, HEIGHT, WIDTH) * 2 - 1
    names = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    return [_compare(network.to(name), pair.to(name)) for name in names]


def _compare(network: PointMapNetwork, pair: Float[Tensor, "2 1 3 h w"]) -> Row:
    def points() -> Float[Tensor, "2 h w 3"]:
        with torch.inference_mode():
            return torch.cat([prediction.points for prediction in network(pair[0], pair[1])])

    def points_written_out() -> Float[Tensor, "2 h w 3"]:
        with sdpa_kernel(SDPBackend.MATH):
            return points()

    case = f"MASt3R, one pair, {WIDTH}x{HEIGHT}, 689 M parameters"
    device = pair.device
    return compare(case, device, points, points_written_out, REPEATS[device.type])
