"""The preparation of one sequence: its frames with depth, then its pairs with their corrections.

A job reads the sequence's photographs and writes the sequence's folders. Finished folders are left
alone, so running a job twice costs nothing.
"""

import errno
import logging
from dataclasses import dataclass
from pathlib import Path

import torch

from data_prep.correct import METHOD
from data_prep.model_cache import PrepModels
from data_prep.pairs import PairFiles, choose_pairs, correct_pairs
from extrap_train.config import PrepConfig
from extrap_train.data.frame_files import (
    CAMERAS,
    StoredFrames,
    frames_folder,
    is_sealed,
    read_camera_table,
    write_frames,
)
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.square_frames import make_frames
from extrap_train.device import is_out_of_memory
from extrap_train.errors import InputError

LOG = logging.getLogger(__name__)
NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
"""What ends the whole run: the next sequence would find no room either."""


@dataclass(frozen=True)
class PrepContext:
    """What all jobs of a preparation share; small, because every job carries it."""

    models: PrepModels
    options: PrepConfig
    frames_root: Path
    """Preparations with other pair options share the frames here."""
    pairs_root: Path
    """Preparations of other sequences share the pairs and corrections here."""

    @property
    def correction(self) -> str:
        """How warps are corrected; empty where they are not."""
        identity = self.models.correction_identity
        return identity and f"{identity}, method {METHOD}"


@dataclass(frozen=True)
class SequenceJob:
    """One sequence to prepare, and its role."""

    context: PrepContext
    sequence: FrameSequence
    role: str
    """`train`, `test` or `train and test` (`split.Split.role`)."""
    capture_key: str
    """What its frames are made from (`CaptureKeys.frames_key`), but for the role."""
    progress: bool = False
    """Whether to show the progress of its pairs, as for a single sequence."""

    @property
    def name(self) -> str:
        """`category/name`, as the prepared data calls it."""
        return f"{self.sequence.category}/{self.sequence.name}"

    @property
    def is_lone(self) -> bool:
        """Whether frames of it are held out."""
        return self.role == "train and test"

    @property
    def frames_key(self) -> str:
        """What the frames are made from."""
        return f"{self.capture_key}{' with frames held out' if self.is_lone else ''}"

    @property
    def frames_folder(self) -> Path:
        """Where they lie."""
        return frames_folder(self.context.frames_root, self.name, self.is_lone)

    @property
    def is_there(self) -> bool:
        """Whether frames and pairs are whole and made from what is asked for."""
        frames = is_sealed(self.frames_folder / CAMERAS, self.frames_key)
        return frames and self.pair_files.are_there()

    @property
    def pair_files(self) -> PairFiles:
        """Where the pairs lie, and what they are made from."""
        context = self.context
        made_from = (self.frames_key, self.role, context.options, context.correction)
        return PairFiles.of(context.pairs_root, self.name, *made_from)


def prepare_sequence(job: SequenceJob) -> str:
    """Make the frames and pairs that are missing; returns why the sequence cannot be used, or "".

    An error costs its sequence alone, even if it is a bug; a bug's traceback is logged. A full disk
    is raised, and MemoryError where memory ends, a GPU's or the machine's: other processes may have
    held it, so the launcher tries again.
    """
    try:
        _prepare(job)
    except InputError as error:
        return str(error)
    except OSError as error:
        if error.errno in NO_SPACE:
            raise
        return f"sequence {job.name}: {error}"
    except Exception as error:
        if is_out_of_memory(error):
            # Every launcher knows MemoryError; torch's own error is none.
            raise MemoryError(str(error).split("\n")[0]) from None
        LOG.exception("sequence %s is left out: %r", job.name, error)
        return f"sequence {job.name}: {type(error).__name__}: {error}"
    return ""


def _prepare(job: SequenceJob) -> None:
    context, folder, key = job.context, job.frames_folder, job.frames_key
    table = read_camera_table(folder, key)
    if table is None:
        source = context.models.depth_source()
        frames = make_frames(job.sequence, source, context.options.image_size, job.is_lone)
        write_frames(folder, frames, key)
        table = read_camera_table(folder, key)
        if table is None:
            raise OSError(f"{folder}: the disk has not kept what was written")
    files = job.pair_files
    if files.are_there():
        return
    stored, options = StoredFrames.open(folder, table), context.options
    with torch.inference_mode():
        pairs = choose_pairs(stored, job.name, job.role, options)
        matcher, grid = context.models.matcher(), options.correction_grid
        files.write(*correct_pairs(stored, pairs, matcher, grid, job.progress))
