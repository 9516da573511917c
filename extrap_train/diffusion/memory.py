"""How much memory training takes, known before it starts, and what helps where it ends."""

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import WeakIdKeyDictionary

from extrap_train.config import LoraConfig, ModelConfig, TrainerConfig
from extrap_train.device import is_out_of_memory
from extrap_train.diffusion.denoiser import build_unet
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError

GIB = 2**30
_ADAM_MOMENTS = 2


class LiveBytes(TorchDispatchMode):
    """Counts the bytes of the tensors that are made while it is entered, and their peak.

    It sees storages, so a view costs nothing, and what an operator uses inside of itself is not
    seen. With fake tensors nothing is computed and the count is the same.
    """

    def __init__(self, known: Iterator[Tensor]) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._seen = WeakIdKeyDictionary()
        for tensor in known:
            self._seen[tensor.untyped_storage()] = True

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        result = function(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor):
                self._count(leaf.untyped_storage())
        return result

    def _count(self, storage: torch.UntypedStorage) -> None:
        if storage in self._seen:
            return
        self._seen[storage] = True
        size = storage.nbytes()
        self.now += size
        self.peak = max(self.peak, self.now)
        weakref.finalize(storage, self._freed, size)

    def _freed(self, size: int) -> None:
        self.now -= size


@dataclass(frozen=True)
class TrainingMemory:
    """Bytes that training holds."""

    weights: int
    """Trained and frozen."""
    optimizer: int
    average: int
    step: int
    """Activations and gradients at their peak."""
    batch_size: int

    @property
    def total(self) -> int:
        """All of it at the peak of a step, without what the libraries themselves take."""
        return self.weights + self.optimizer + self.average + self.step

    @property
    def is_worth_a_word(self) -> bool:
        """Whether it is so much that one has to plan for it."""
        return self.total > GIB

    def __str__(self) -> str:
        parts = {
            "weights": self.weights,
            "optimiser": self.optimizer,
            "average": self.average,
            f"a step of batch {self.batch_size}": self.step,
        }
        listed = ", ".join(f"{name} {size / GIB:.1f}" for name, size in parts.items() if size)
        return f"memory needed: {self.total / GIB:.1f} GiB ({listed})"


def training_memory(model: ExtrapolationModel, options: TrainerConfig) -> TrainingMemory:
    """What training the model takes on each device; the step is measured with fake tensors."""
    trained = _bytes(model.parameters())
    everything = sum(_bytes(network.parameters()) for network in model.parts().values())
    return TrainingMemory(
        weights=everything,
        optimizer=_ADAM_MOMENTS * trained,
        average=trained * (options.ema_decay > 0),
        step=_step_bytes(model.config, model.unet.config["in_channels"], options)
        if everything > GIB // 8
        else trained,
        batch_size=options.batch_size,
    )


def _step_bytes(config: ModelConfig, in_channels: int, options: TrainerConfig) -> int:
    """Peak of the denoiser's forward and backward pass, its gradients included."""
    lower = torch.bfloat16 if options.precision.startswith("bf16") else torch.float16
    mixed = options.precision.endswith("mixed")
    with FakeTensorMode():
        factor = config.patch if config.vae is None else 2 ** (len(config.vae.channels) - 1)
        side = config.image_size // factor
        channels = 3 * config.patch**2 if config.vae is None else 4
        unet = build_unet(config.unet, in_channels, channels, side).train()
        if options.gradient_checkpointing:
            unet.enable_gradient_checkpointing()
        count = options.batch_size
        noisy = torch.empty(count, in_channels, side, side)
        token = torch.empty(count, 1, config.unet.token_width)
        steps = torch.zeros(count, dtype=torch.long)
        with LiveBytes(unet.parameters()) as live:
            with torch.autocast("cpu", lower, enabled=mixed):
                loss = unet(noisy, steps, token).sample.float().square().mean()
            loss.backward()
    return live.peak


def _bytes(tensors: Iterator[Tensor]) -> int:
    return sum(x.numel() * x.element_size() for x in tensors)


@contextmanager
def advice_where_memory_ends(options: TrainerConfig) -> Iterator[None]:
    """Turn running out of memory in training into one line with what helps; other errors pass."""
    remedies = [
        (not options.gradient_checkpointing, "trainer.gradient_checkpointing=true"),
        (options.batch_size > 1, f"trainer.batch_size={max(1, options.batch_size // 2)}"),
        (options.ema_decay > 0, "trainer.ema_decay=0 (no averaged weights)"),
    ]
    with _one_line(f"at trainer.batch_size={options.batch_size}", remedies):
        yield


@contextmanager
def advice_where_adapting_ends(lora: LoraConfig, trainer: TrainerConfig) -> Iterator[None]:
    """`advice_where_memory_ends` for an adapter's training."""
    remedies = [
        (not trainer.gradient_checkpointing, "trainer.gradient_checkpointing=true"),
        (lora.batch_size > 1, f"lora.batch_size={max(1, lora.batch_size // 2)}"),
        (lora.convolutions, "lora.convolutions=false"),
    ]
    with _one_line(f"at lora.batch_size={lora.batch_size}", remedies):
        yield


@contextmanager
def advice_where_painting_ends(at_once: int, trainer: TrainerConfig) -> Iterator[None]:
    """`advice_where_memory_ends` for painting so many views at once."""
    remedies = [
        (at_once > 1, f"painted_at_once={max(1, at_once // 2)}"),
        (torch.cuda.is_available() and trainer.accelerator != "cpu", "trainer.accelerator=cpu"),
    ]
    with _one_line(f"painting {at_once} at once", remedies):
        yield


@contextmanager
def _one_line(where: str, remedies: list[tuple[bool, str]]) -> Iterator[None]:
    """InputError with the first two remedies that are left, each with whether it is."""
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        left = [remedy for helps, remedy in remedies if helps][:2]
        advice = f"give {' or '.join(left)}" if left else "it takes a device with more memory"
        raise InputError(f"out of memory {where}: {advice}") from None
