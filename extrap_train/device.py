"""Where a network runs that is only used, not trained; how it says that memory ends."""

import torch


def fastest_device() -> torch.device:
    """The GPU where there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a GPU's memory or the machine's is used up."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    # torch has no type of its own for the machine's memory.
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)
