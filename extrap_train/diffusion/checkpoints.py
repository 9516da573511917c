"""Checkpoints of a training run: written whole, checked before a run resumes from one, and saved
when a signal ends the training.
"""

import os
import signal
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, cast

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback

from extrap_train.errors import InputError, Terminated
from extrap_train.store.atomic import atomic_file
from extrap_train.weight_files import DAMAGE

_KEPT = 2
_AGREED_EVERY = 10
"""Steps between two questions of several processes whether to stop: each waits for all GPUs."""
_ENTRIES: dict[str, type] = {
    "global_step": int,
    "state_dict": dict,
    "optimizer_states": list,
    "lr_schedulers": list,
    "callbacks": dict,
    "loops": dict,
}
"""Entries of a checkpoint that Lightning cannot resume without."""
_AVERAGE = ("current_model_state", "averaging_state")
"""Entries needed where weights are averaged; Lightning itself would go on without the average."""
_PIECE_BYTES = 2**20


class WholeCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint complete or not at all, and maps it to read it."""

    def load_checkpoint(
        self,
        path: str | os.PathLike[str],
        map_location: Any = "cpu",
        weights_only: bool | None = True,
    ) -> dict[str, Any]:
        """Map the file, of which each page is read when it is used: weights and moments go from
        there into the model's own memory, without a second copy beside them.

        Nothing but tensors and plain values is made, whatever is asked for.
        """
        loaded = torch.load(path, map_location=map_location, weights_only=True, mmap=True)
        return cast(dict[str, Any], loaded)

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any = None
    ) -> None:
        """Write under a temporary name, then rename what has reached the disk.

        torch computes a checksum of every tensor while it writes: CRC-32, as in any zip archive.
        """
        path = Path(path)
        with atomic_file(path) as temporary:
            try:
                torch.save(checkpoint, temporary)  # not by way of memory: it is 14 GB at full size
            except RuntimeError as error:
                reason = str(error).splitlines()[0]
                raise InputError(
                    f"{path}: cannot be written ({reason}); free space or choose another output="
                ) from None


def find_damage(path: Path, entries: Mapping[str, type] = _ENTRIES) -> str | None:
    """What is wrong with a checkpoint: a checksum, its format, or an entry that it lacks.

    Reads the file once; its tensors are not kept in memory.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                if entry.compress_type != zipfile.ZIP_STORED:
                    return f"{entry.filename} is compressed, which torch never does"
                with archive.open(entry) as content:
                    while content.read(_PIECE_BYTES):
                        pass  # the reader compares the checksum at the end
        found = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except DAMAGE as error:
        return f"{type(error).__name__} {error}".splitlines()[0]
    if not isinstance(found, dict):
        return "it holds no mapping"
    odd = [name for name, kind in entries.items() if not isinstance(found.get(name), kind)]
    if not odd and any(name in found for name in _AVERAGE):
        odd = [name for name in _AVERAGE if not isinstance(found.get(name), dict)]
    return f"no {odd[0]}" if odd else None


def checkpoints(folder: Path) -> list[Path]:
    """Complete checkpoints, oldest first."""
    return sorted(path for path in folder.glob("step-*.ckpt") if _step_text(path).isdigit())


def step_of(checkpoint: Path) -> int:
    """After how many steps a checkpoint was saved, by its name."""
    return int(_step_text(checkpoint))


def _step_text(checkpoint: Path) -> str:
    return checkpoint.stem.removeprefix("step-")


def newest_intact(folder: Path, say: Callable[[str], None]) -> Path | None:
    """The checkpoint to resume from; of each newer one that is damaged, a line says why."""
    for path in reversed(checkpoints(folder)):
        damage = find_damage(path)
        if damage is None:
            return path
        say(f"{path}: passed over, damaged ({damage})")
    return None


def thin_checkpoints(folder: Path, keep: int) -> None:
    """Remove all but the newest checkpoints of a run that is finished."""
    there = checkpoints(folder)
    for old in there[: max(0, len(there) - keep)]:
        old.unlink(missing_ok=True)


@contextmanager
def restoring(checkpoint: str | None, has_begun: Callable[[], bool]) -> Iterator[None]:
    """Name the checkpoint in what goes wrong before training has begun from it."""
    try:
        yield
    except InputError:
        raise
    except DAMAGE as error:
        if checkpoint is None or has_begun():
            raise
        reason = f"{type(error).__name__} {error}".splitlines()[0]
        raise _unusable(checkpoint, reason) from error


class _Stop(BaseException):
    """Ends a training from within: of KeyboardInterrupt, Lightning would make `sys.exit(1)`."""


class Checkpoints(Callback):
    """Saves at the end of every epoch, and where a signal ends the training; keeps two.

    Epochs end at the multiples of `every` steps, wherever a run resumes (`PairModule`). A resumed
    run starts as at the first batch of an epoch and sees exactly the batches that it would have
    seen.
    """

    def __init__(self, folder: Path, every: int) -> None:
        self.folder, self.every = folder, every
        self.has_begun = False
        self._trains = False
        self._owner: int | None = None
        self._received: int | None = None

    @contextmanager
    def stoppable(self) -> Iterator[None]:
        """SIGINT and SIGTERM end the block with KeyboardInterrupt, which says where it resumes.

        While the model trains, the step in hand is finished and saved first, and a validation in
        hand is finished; a second signal ends either at once.
        """
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        self._owner = os.getpid()
        self._listen()
        try:
            yield
            if self._received is not None:  # in the last step
                raise _Stop
        except _Stop:
            raise self._interruption() from None
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _listen(self) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if os.getpid() != self._owner:  # a worker that loads batches ends with its parent
            return
        is_second = self._received is not None
        self._received = number
        if is_second or not self._trains:
            raise _Stop
        os.write(2, b"stopping after this step or validation; interrupt again to stop at once\n")

    def _interruption(self) -> KeyboardInterrupt:
        newest = checkpoints(self.folder)[-1:]
        step = step_of(newest[0]) if newest else 0
        kind = Terminated if self._received == signal.SIGTERM else KeyboardInterrupt
        return kind(f"stopped at step {step}; the same command resumes from there")

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take SIGTERM back from Lightning, which would end without a checkpoint."""
        _require_fitting_moments(trainer)
        if self._owner is not None:
            self._listen()
        self.has_begun = self._trains = True

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save and stop if a signal came; at the end of an epoch, after its validation."""
        step = trainer.global_step
        is_between = step % self.every and step < trainer.max_steps
        is_agreed = trainer.world_size == 1 or step % _AGREED_EVERY == 0
        if is_between and is_agreed and self._is_to_stop(trainer):
            self._save(trainer)
            raise _Stop

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save, and stop if a signal came."""
        self._save(trainer)
        if trainer.global_step < trainer.max_steps and self._is_to_stop(trainer):
            raise _Stop

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """From here on a signal ends the command at once: every step is saved."""
        self._trains = False

    def _is_to_stop(self, trainer: Trainer) -> bool:
        """Whether any process received a signal: all of them stop at the same step."""
        return trainer.strategy.reduce_boolean_decision(self._received is not None, all=False)

    def _save(self, trainer: Trainer) -> None:
        newest = self.folder / f"step-{trainer.global_step:08d}.ckpt"
        trainer.save_checkpoint(newest)
        if trainer.is_global_zero:
            there = checkpoints(self.folder)
            kept = there[: there.index(newest) + 1][-_KEPT:]
            for other in set(there) - set(kept):  # newer ones were damaged
                other.unlink()

    def on_load_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Let the run resume at the start of an epoch, which began at the last multiple of `every`.

        Lightning counts an epoch as unfinished while its end's callbacks run; resumed with a limit
        of steps, it would insert an epoch of a single batch.
        """
        progress = checkpoint["loops"]["fit_loop"]
        epochs = checkpoint["global_step"] // self.every
        for span in ("total", "current"):
            epoch = progress["epoch_progress"][span]
            epoch.update(dict.fromkeys(epoch, epochs))
        batches = progress["epoch_loop.batch_progress"]
        batches["total"] = dict.fromkeys(batches["total"], checkpoint["global_step"])
        batches["current"] = dict.fromkeys(batches["current"], 0)
        batches["is_last_batch"] = False


def _require_fitting_moments(trainer: Trainer) -> None:
    """torch loads an optimiser's state of any shape, and fails in the first step."""
    for optimizer in trainer.optimizers:
        for parameter, state in optimizer.state.items():
            for name, value in state.items():
                if (
                    isinstance(value, torch.Tensor)
                    and value.ndim
                    and value.shape != parameter.shape
                ):
                    raise _unusable(trainer.ckpt_path, f"its {name} is of another shape")


def _unusable(checkpoint: object, reason: str) -> InputError:
    return InputError(
        f"{checkpoint}: cannot be resumed from ({reason}); delete it to resume from the "
        "checkpoint before it"
    )
