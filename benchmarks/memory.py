"""Peak memory of a block, although a worker process lives through many."""

from pathlib import Path

import torch

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_RESET_PEAK = "5"


class PeakMemory:
    """A `with` block's peak in MiB: of the GPU where there is one, else of the process.

    `mib` is None where the system (no Linux) cannot say.
    """

    mib: float | None = None

    def __enter__(self) -> "PeakMemory":
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()
        elif _CLEAR.exists():
            _CLEAR.write_text(_RESET_PEAK)
        return self

    def __exit__(self, *_: object) -> None:
        if torch.cuda.is_available():
            self.mib = torch.cuda.max_memory_allocated() / 2**20
        elif _STATUS.exists():
            lines = dict(line.split(":", 1) for line in _STATUS.read_text().splitlines())
            self.mib = float(lines["VmHWM"].split()[0]) / 1024
