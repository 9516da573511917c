"""Where a network runs and what it computes in; how it says that there is no such place, or that
memory ends.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch

from extrap_train.config import LoraConfig, TrainerConfig
from extrap_train.errors import InputError

Advice = AbstractContextManager[None]
"""Turns running out of memory within it into one line with what helps; other errors pass."""


def fastest_device() -> torch.device:
    """The GPU where there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def require_accelerator(accelerator: str) -> None:
    """InputError where this machine has none of what `trainer.accelerator` names."""
    cuda, mps = torch.cuda.is_available(), torch.backends.mps.is_available()
    if not {"gpu": cuda or mps, "cuda": cuda, "mps": mps}.get(accelerator, True):
        raise InputError(
            f"trainer.accelerator={accelerator}: torch {torch.__version__} finds none on this "
            "machine (driver, or a torch without it?); give trainer.accelerator=auto or cpu"
        )


def resolve_precision(precision: str, device: torch.device) -> str:
    """`trainer.precision` with `auto` resolved for a device.

    Without units for bfloat16 a processor emulates it: convolutions take some 18 times as long as
    in single precision.
    """
    if precision != "auto":
        return precision
    if device.type == "cuda":
        has_units = torch.cuda.is_bf16_supported(including_emulation=False)
    else:  # torch has no public function for this
        has_units = device.type == "cpu" and (
            torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
        )
    return "bf16-mixed" if has_units else "32-true"


def trainer_device(options: TrainerConfig) -> torch.device:
    """Where `trainer.accelerator` lets networks run."""
    return torch.device("cpu") if options.accelerator == "cpu" else fastest_device()


def trainer_precision(options: TrainerConfig) -> str:
    """`trainer.precision` resolved for `trainer.accelerator`."""
    return resolve_precision(options.precision, trainer_device(options))


def autocast(device: torch.device, precision: str) -> AbstractContextManager[object]:
    """What a network computes in, by the names of `trainer.precision`; `32-true` changes nothing.

    As Lightning does, it takes bfloat16 for half precision on a CPU, which is slow in that.
    """
    precision = resolve_precision(precision, device)
    if precision == "32-true":
        return nullcontext()
    is_half = precision == "16-mixed" and device.type != "cpu"
    return torch.autocast(device.type, torch.float16 if is_half else torch.bfloat16)


@contextmanager
def single_precision(device: torch.device) -> Iterator[None]:
    """Let networks compute in single precision; on a GPU their products may round to TF32.

    The geometry's products never may, so that it is no setting of the whole process: a pose far
    from the world's origin would lose its translation.
    """
    before = torch.get_float32_matmul_precision()
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    try:
        with torch.autocast(device.type, enabled=False):
            yield
    finally:
        torch.set_float32_matmul_precision(before)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a GPU's memory or the machine's is used up."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    # torch has no type of its own for the machine's memory.
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)


def advise_on_training_memory(options: TrainerConfig) -> Advice:
    """For training a model."""
    remedies = [
        (not options.gradient_checkpointing, "trainer.gradient_checkpointing=true"),
        (options.batch_size > 1, f"trainer.batch_size={max(1, options.batch_size // 2)}"),
        (options.ema_decay > 0, "trainer.ema_decay=0 (no averaged weights)"),
    ]
    return _out_of_memory_advice(f"at trainer.batch_size={options.batch_size}", remedies)


def advise_on_adapting_memory(lora: LoraConfig, trainer: TrainerConfig) -> Advice:
    """For an adapter's training."""
    remedies = [
        (not trainer.gradient_checkpointing, "trainer.gradient_checkpointing=true"),
        (lora.batch_size > 1, f"lora.batch_size={max(1, lora.batch_size // 2)}"),
        (lora.convolutions, "lora.convolutions=false"),
    ]
    return _out_of_memory_advice(f"at lora.batch_size={lora.batch_size}", remedies)


def advise_on_sampling_memory(at_once: int, trainer: TrainerConfig) -> Advice:
    """Advice for a GPU that ran out of memory while `at_once` views were sampled."""
    remedies = [
        (at_once > 1, f"sample_batch_size={max(1, at_once // 2)}"),
        (torch.cuda.is_available() and trainer.accelerator != "cpu", "trainer.accelerator=cpu"),
    ]
    return _out_of_memory_advice(f"sampling {at_once} views at once", remedies)


@contextmanager
def _out_of_memory_advice(where: str, remedies: list[tuple[bool, str]]) -> Iterator[None]:
    """InputError with the first two remedies that are left, each with whether it is."""
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        left = [remedy for helps, remedy in remedies if helps][:2]
        advice = f"give {' or '.join(left)}" if left else "it takes a device with more memory"
        raise InputError(f"out of memory {where}: {advice}") from None
