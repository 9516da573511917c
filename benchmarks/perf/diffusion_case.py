"""The diffusion model that is timed: full size on a GPU, a slim one of the same make on a CPU."""

import copy
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import torch
from diffusers.models.attention_processor import AttnProcessor
from jaxtyping import Float
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.perf.timing import Timing, compare
from benchmarks.perf.warp_timing import ANGLES_DEG, QUERY_ANGLE_DEG, orbit_camera
from extrap_train.config import NEAREST_ALONE, ClipConfig, ModelConfig, UNetConfig, VaeConfig
from extrap_train.diffusion.encoders import Frozen
from extrap_train.diffusion.model import ExtrapolationModel, use_channels_last
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import PairBatch, stack_cameras

IMAGE_SIZE = 256
PEAK_TFLOPS = {"H200": 989, "H100": 989, "A100": 312, "A6000": 155, "4090": 165}
"""Dense bfloat16 matrix products that the makers state, by a part of the device's name."""


Run = Callable[[], Float[Tensor, "..."]]
_MODELS = {"cpu": ("0.3 of the width", 96, (1, 4)), "cuda": ("full size", 320, (1, 4, 16, 32))}
"""Name of the model, channels of its finest level, and batch sizes; the paper trains with 4."""


def compare_models(
    device: torch.device,
    title: str,
    passes: int,
    ours: Callable[[ExtrapolationModel, PairBatch], Run],
    reference: Callable[[ExtrapolationModel, PairBatch], Run],
    repeats: int,
) -> list[Timing]:
    """One row per batch size, on a GPU with torch.compile as well.

    Prints the speed and memory of both, each of which costs `passes` forward passes an image.
    `reference` is built with the plain copy of the model.
    """
    rows = []
    name, width, counts = _MODELS[device.type]
    config, on_gpu = configuration(width), device.type == "cuda"
    for count, compiled in product(counts, (False, True) if on_gpu else (False,)):
        model, batch = optimised(config, device), batch_of(count, device)
        theirs = reference(plain(model), batch)
        if compiled:
            model.unet.compile()
        mine = ours(model, batch)
        case = f"{title}, {name}, batch {count}{', compiled' if compiled else ''}"
        row = compare(case, device, mine, theirs, repeats)
        flops = passes * count * forward_flops(config)
        print(f"{case}: {_describe(device, count, row.ours_ms, mine, flops)}")
        print(f"  plain float32: {_describe(device, count, row.reference_ms, theirs, flops)}")
        rows.append(row)
    return rows


def configuration(width: int, family: str = "ours") -> ModelConfig:
    """A family as `model=` has it, with `width` channels at its finest level."""
    return ModelConfig(
        name="perf",
        family=family,
        references=1 if family in NEAREST_ALONE else 3,
        image_size=IMAGE_SIZE,
        vae=VaeConfig(channels=[32 * max(1, round(width / 80)) * x for x in (1, 2, 4, 4)]),
        clip=ClipConfig(width=64 * (width // 20), heads=width // 20),
        residual=False,
        prediction="epsilon",
        zero_terminal_snr=False,
        unet=UNetConfig(
            channels=[width, 2 * width, 4 * width, 4 * width],
            layers_per_block=2,
            attention_levels=[True, True, True, False],
            heads=8,
            token_width=768,
            norm_groups=32,
        ),
    )


def optimised(config: ModelConfig, device: torch.device) -> ExtrapolationModel:
    """The model with random weights, none of them zero, in the layout that tasks use."""
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
        unet = ExtrapolationModel(replace(config, clip=None)).unet  # which it does not depend on
        unet.set_attn_processor(AttnProcessor())  # products that the counter knows
        channels, side = unet.config["in_channels"], unet.config["sample_size"]
        with FlopCounterMode(display=False) as counter:
            unet(
                torch.empty(1, channels, side, side),
                torch.zeros(1, dtype=torch.long),
                torch.empty(1, 1, config.unet.token_width),
            )
    return counter.get_total_flops()


def _describe(device: torch.device, images: int, milliseconds: float, run: Run, flops: int) -> str:
    """Images per second and achieved FLOP/s; on a GPU also peak memory and share of its peak."""
    achieved = flops / milliseconds / 1e9
    parts = [f"{1e3 * images / milliseconds:.3g} images/s", f"{achieved:.3g} TFLOP/s"]
    if device.type == "cuda":
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        run()
        peak = torch.cuda.max_memory_allocated() - before
        parts.append(f"{peak / 2**20:.0f} MiB on top of the weights")
        name = torch.cuda.get_device_name()
        limits = [limit for part, limit in PEAK_TFLOPS.items() if part in name]
        parts += [f"{100 * achieved / limit:.0f} % of the {name}'s peak" for limit in limits]
    return ", ".join(parts)
