"""Where a network runs and what it computes in; how it says that there is no such place, or that
memory ends.
"""

from contextlib import AbstractContextManager, nullcontext

import torch

from extrap_train.errors import InputError


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


def autocast(device: torch.device, precision: str) -> AbstractContextManager[object]:
    """What a network computes in, by the names of `trainer.precision`; `32-true` changes nothing.

    As Lightning does, it takes bfloat16 for half precision on a CPU, which is slow in that.
    """
    if precision == "32-true":
        return nullcontext()
    is_half = precision == "16-mixed" and device.type != "cpu"
    return torch.autocast(device.type, torch.float16 if is_half else torch.bfloat16)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a GPU's memory or the machine's is used up."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    # torch has no type of its own for the machine's memory.
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)
