"""The preparation of one sequence: its frames with depth, then its pairs with their corrections.

A unit is a job of its own: it reads the sequence's photographs, writes the sequence's folders and
returns a word. What is finished is left alone, so that a unit that is asked for twice costs
nothing.
"""

import errno
import logging
from dataclasses import dataclass
from pathlib import Path

from data_prep.correct import METHOD
from data_prep.frames import make_frames
from data_prep.pairs import PairFiles, make_pairs
from data_prep.tools import Tools
from extrap_train.config import PrepConfig
from extrap_train.data.frame_files import (
    CAMERAS,
    StoredFrames,
    frames_folder,
    is_sealed,
    read_camera_table,
    write_frames,
)
from extrap_train.data.sequences import Sequence
from extrap_train.device import is_out_of_memory
from extrap_train.errors import InputError

LOG = logging.getLogger(__name__)
NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
"""What ends the whole run: the next sequence would find no room either."""


@dataclass(frozen=True)
class Workshop:
    """What all units of a preparation share; small, because every job takes it along."""

    tools: Tools
    options: PrepConfig
    frames: Path
    """Root of the frames, which preparations with other pair options share."""
    pairs: Path
    """Root of the pairs and their corrections, which preparations of other sequences share."""

    @property
    def correction(self) -> str:
        """How warps are corrected; empty where they are not."""
        how = self.tools.correction_identity
        return how and f"{how}, method {METHOD}"


@dataclass(frozen=True)
class Unit:
    """One sequence, and what it is for."""

    workshop: Workshop
    sequence: Sequence
    role: str
    """`train`, `test` or `train and test` (`split.Split.role`)."""
    capture_key: str
    """What its frames are made from (`CaptureKeys.frames_key`), but for the role."""
    progress: bool = False
    """Whether to show how far its pairs are: where the number of sequences says little."""

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
        return frames_folder(self.workshop.frames, self.name, self.is_lone)

    @property
    def is_there(self) -> bool:
        """Whether frames and pairs are whole and made from what is asked for."""
        return is_sealed(self.frames_folder / CAMERAS, self.frames_key) and (
            self.pair_files.are_there()
        )

    @property
    def pair_files(self) -> PairFiles:
        """Where the pairs lie, and what they are made from."""
        shop = self.workshop
        made_from = (self.frames_key, self.role, shop.options, shop.correction)
        return PairFiles.of(shop.pairs, self.name, *made_from)


def prepare_unit(unit: Unit) -> str:
    """Make what the sequence lacks; returns why it cannot be used, or nothing.

    Whatever goes wrong with one sequence stays with it, bugs included, whose trace is logged. A
    full disk is raised, and MemoryError where memory ends, a GPU's or the machine's: others may
    have held it, so the launcher tries again.
    """
    try:
        _prepare(unit)
    except InputError as error:
        return str(error)
    except OSError as error:
        if error.errno in NO_SPACE:
            raise
        return f"sequence {unit.name}: {error}"
    except Exception as error:
        if is_out_of_memory(error):
            # What every launcher knows; torch's own is no MemoryError.
            raise MemoryError(str(error).split("\n")[0]) from None
        LOG.exception("sequence %s is left out: %r", unit.name, error)
        return f"sequence {unit.name}: {type(error).__name__}: {error}"
    return ""


def _prepare(unit: Unit) -> None:
    shop, key = unit.workshop, unit.frames_key
    table = read_camera_table(unit.frames_folder, key)
    if table is None:
        source = shop.tools.depth_source()
        frames = make_frames(unit.sequence, source, shop.options.image_size, unit.is_lone)
        write_frames(unit.frames_folder, frames, key)
        table = read_camera_table(unit.frames_folder, key)
        if table is None:
            raise OSError(f"{unit.frames_folder}: the disk has not kept what was written")
    stored = StoredFrames.open(unit.frames_folder, table)
    make_pairs(
        unit.pair_files, stored, unit.name, unit.role, shop.options, shop.tools, unit.progress
    )
