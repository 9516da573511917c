"""The diffusion model that is timed: full size on a GPU, a slim one of the same make on a CPU."""

import copy
from collections.abc import Callable
from dataclasses import dataclass

import torch
from diffusers.models.attention_processor import AttnProcessor
from jaxtyping import Float
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.perf.live_bytes import LiveBytes
from benchmarks.perf.timing import Row, compare
from benchmarks.perf.warp_timing import ANGLES_DEG, QUERY_ANGLE_DEG, orbit_camera
from extrap_train.config import ClipConfig, ModelConfig, UNetConfig, VaeConfig
from extrap_train.data.module import compute_warp
from extrap_train.diffusion.encoders import Frozen
from extrap_train.diffusion.model import ExtrapolationModel, use_channels_last
from extrap_train.views import PairBatch, stack_cameras

IMAGE_SIZE = 256
PEAK_TFLOPS = {"H200": 989, "H100": 989, "A100": 312, "A6000": 155, "4090": 165}
"""Dense bfloat16 matrix products that the makers state, by a part of the device's name."""


@dataclass(frozen=True)
class Size:
    """A model of the full size's make, and what it is called in the table."""

    name: str
    width: int
    """Channels of the finest level; 320 is the full size."""


def devices() -> list[tuple[torch.device, Size, tuple[int, ...]]]:
    """Where to measure, what, and at which batch sizes; the paper trains with 4."""
    measured: list[tuple[torch.device, Size, tuple[int, ...]]]
    measured = [(torch.device("cpu"), Size("0.3 of the width", 96), (1, 4))]
    if torch.cuda.is_available():
        measured.append((torch.device("cuda"), Size("full size", 320), (1, 4, 16, 32)))
    return measured


def run_all(compare_case: Callable[[torch.device, Size, int, bool], Row]) -> list[Row]:
    """A row per device and batch size, on a GPU also with torch.compile."""
    return [
        compare_case(device, size, count, compiled)
        for device, size, counts in devices()
        for count in counts
        for compiled in ((False, True) if device.type == "cuda" else (False,))
    ]


def compare_and_report(
    case: str,
    device: torch.device,
    count: int,
    ours: Callable[[], Float[Tensor, "..."]],
    reference: Callable[[], Float[Tensor, "..."]],
    repeats: int,
    flops: int,
) -> Row:
    """The row of two implementations; prints the speed and memory of both."""
    row = compare(case, device, ours, reference, repeats)
    for name, run_once, taken in (
        (case, ours, row.ours_ms),
        ("  plain float32", reference, row.reference_ms),
    ):
        print(report(name, device, count, taken, peak_mib(device, run_once), flops))
    return row


def configuration(size: Size) -> ModelConfig:
    """The family `ours` as `model=ours` configures it, at another width."""
    wide, narrow = 4 * size.width, size.width
    return ModelConfig(
        name="perf",
        image_size=IMAGE_SIZE,
        vae=VaeConfig(channels=[32 * max(1, round(narrow / 80)) * x for x in (1, 2, 4, 4)]),
        clip=ClipConfig(width=64 * (narrow // 20), heads=narrow // 20),
        residual=False,
        prediction="epsilon",
        zero_terminal_snr=False,
        unet=UNetConfig(
            channels=[narrow, 2 * narrow, wide, wide],
            layers_per_block=2,
            attention_levels=[True, True, True, False],
            heads=8,
            token_width=768,
            norm_groups=32,
        ),
    )


def optimised(config: ModelConfig, device: torch.device) -> ExtrapolationModel:
    """The model with random weights, none of them zero, as tasks arrange it to train and paint."""
    torch.manual_seed(0)
    model = ExtrapolationModel(config).to(device)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.02)
    return use_channels_last(model)


def plain(model: ExtrapolationModel) -> ExtrapolationModel:
    """The same network without optimisations: attention as three products, contiguous layout."""
    copied = copy.deepcopy(model)
    for frozen in (copied.autoencoder, copied.image_encoder):
        if isinstance(frozen, Frozen):  # copies of a model share them
            frozen.network = copy.deepcopy(frozen.network)
    for network in copied.parts().values():
        network.to(memory_format=torch.contiguous_format)
    copied.unet.set_attn_processor(AttnProcessor())
    return copied


def batch_of(count: int, device: torch.device) -> PairBatch:
    """Views of a wall on an arc, with their warp."""
    generator = torch.Generator().manual_seed(0)
    references = stack_cameras([orbit_camera(angle, IMAGE_SIZE) for angle in ANGLES_DEG])
    shape = (count, len(ANGLES_DEG))
    batch = PairBatch(
        image=torch.rand(count, 3, IMAGE_SIZE, IMAGE_SIZE, generator=generator),
        camera=stack_cameras([orbit_camera(QUERY_ANGLE_DEG, IMAGE_SIZE)] * count),
        reference_images=torch.rand(*shape, 3, IMAGE_SIZE, IMAGE_SIZE, generator=generator),
        reference_cameras=stack_cameras([references] * count),
        reference_depths=torch.full((*shape, IMAGE_SIZE, IMAGE_SIZE), 3.0),
        reference_valid=torch.ones(shape, dtype=torch.bool),
    )
    return compute_warp(batch.to(device))


def forward_flops(config: ModelConfig) -> int:
    """Floating-point operations of one image through the denoiser, attention included."""
    with FakeTensorMode():
        unet = ExtrapolationModel(config).unet
        unet.set_attn_processor(AttnProcessor())  # products that the counter knows
        channels, side = unet.config["in_channels"], unet.config["sample_size"]
        with FlopCounterMode(display=False) as counter:
            unet(
                torch.empty(1, channels, side, side),
                torch.zeros(1, dtype=torch.long),
                torch.empty(1, 1, config.unet.token_width),
            )
    return counter.get_total_flops()


def peak_mib(device: torch.device, step: Callable[[], Float[Tensor, "..."]]) -> float:
    """Most memory that tensors take during a step, beyond those that were there before it."""
    if device.type == "cuda":
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        step()
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    with LiveBytes(iter([])) as live:
        step()
    return live.peak / 2**20


def report(
    case: str, device: torch.device, images: int, milliseconds: float, peak: float, flops: float
) -> str:
    """One line: images a second, memory, and how much of the device that is."""
    seconds = milliseconds / 1e3
    achieved = flops / seconds / 1e12
    name = torch.cuda.get_device_name() if device.type == "cuda" else "CPU"
    limit = next((peak for part, peak in PEAK_TFLOPS.items() if part in name), None)
    share = f", {100 * achieved / limit:.0f} % of the {name}'s peak" if limit else ""
    return (
        f"{case}: {images / seconds:.3g} images/s, {peak:.0f} MiB beside the weights, "
        f"{achieved:.3g} TFLOP/s{share}"
    )
