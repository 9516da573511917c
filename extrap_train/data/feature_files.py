"""Features of prepared frames on disk: what a model's frozen networks say of each, computed once.

<frames>/features_<size>_<encoder>/<category>/<sequence>/latents.npy     n 2 2 z h w, half precision
                                                         embeddings.npy  n 2 d
                                                         features.parquet, its checksums
         lone_features_…    of a sequence with frames held out

The second dimension is the orientation, as photographed and in a mirror; the third of the latents
is mean and spread of the posterior. At 256 pixels a frame takes 36 kB.
"""

import hashlib
import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float16
from torch import Tensor

from extrap_train.data.frame_files import SealedTable, map_array
from extrap_train.data.prepared import PreparedData
from extrap_train.errors import InputError
from extrap_train.views import FrameFeatures

LATENTS, EMBEDDINGS, _TABLE = "latents.npy", "embeddings.npy", "features.parquet"
_REMEDY = "delete the folder and run data_prep with model= and model.start= again"
_VERSION = 1
_OPEN_SEQUENCES = 64
"""Sequences whose files stay mapped."""


@dataclass(frozen=True)
class FrameEncoder:
    """Which frozen networks features are of, and the side of the images that they see."""

    digest: str
    """SHA-256 of their weights and layout (`diffusion.frozen_features`)."""
    image_size: int


class FeatureFiles:
    """The features of one preparation's training sequences by one encoder."""

    def __init__(self, data: PreparedData, encoder: FrameEncoder) -> None:
        self.data, self.encoder = data, encoder
        self._arrays: Callable[[str], _Arrays] = lru_cache(_OPEN_SEQUENCES)(self._open)

    @property
    def sequences(self) -> list[str]:
        """Those that features are wanted of: what is held out is measured on, never trained on."""
        return [name for name, role in self.data.roles.items() if role != "test"]

    def missing(self) -> list[str]:
        """Sequences whose features are not there, or of other frames or networks."""
        return [name for name in self.sequences if not self._table(name).is_there()]

    def write(
        self,
        sequence: str,
        latents: Float16[np.ndarray, "n 2 2 z h w"],
        embeddings: Float16[np.ndarray, "n 2 d"],
    ) -> None:
        """Keep the features of all frames of a sequence, whole or not at all."""
        sums = [_checksum(*frame) for frame in zip(latents, embeddings, strict=True)]
        table = pa.table({"crc32": pa.array(sums, pa.uint32())})
        self._table(sequence).write(table, {LATENTS: latents, EMBEDDINGS: embeddings})

    def read(self, sequence: str, target: int, reference: int) -> FrameFeatures:
        """What stands for a target and a reference, in both orientations.

        InputError where the files are missing, damaged or of other frames.
        """
        arrays = self._arrays(sequence)
        (target_latents, _), (latents, embedding) = (
            arrays.frame(frame) for frame in (target, reference)
        )
        return FrameFeatures(target_latents[:, 0], target_latents[:, 1], latents[:, 0], embedding)

    def _table(self, sequence: str) -> SealedTable:
        made_from = [_VERSION, self.encoder.digest, self.encoder.image_size]
        content = json.dumps([*made_from, self.data.image_checksums(sequence)])
        kind = f"features_{self.encoder.image_size}_{self.encoder.digest[:16]}"
        folder = self.data.beside_frames(kind, sequence)
        return SealedTable(folder / _TABLE, hashlib.sha256(content.encode()).hexdigest())

    def _open(self, sequence: str) -> "_Arrays":
        sealed = self._table(sequence)
        folder, table = sealed.file.parent, sealed.read()
        if table is None:
            raise InputError(f"{folder}: features are missing or of other frames; {_REMEDY}")
        latents, embeddings = (map_array(folder / name) for name in (LATENTS, EMBEDDINGS))
        return _Arrays(sealed, latents, embeddings, table["crc32"].to_numpy())


@dataclass(frozen=True)
class _Arrays:
    """The mapped files of one sequence."""

    sealed: SealedTable
    latents: Float16[np.ndarray, "n 2 2 z h w"]
    embeddings: Float16[np.ndarray, "n 2 d"]
    checksums: np.ndarray

    def frame(self, index: int) -> tuple[Float16[Tensor, "2 2 z h w"], Float16[Tensor, "2 d"]]:
        """Latents and embeddings of one frame; InputError unless they are as they were written."""
        latents, embedding = np.array(self.latents[index]), np.array(self.embeddings[index])
        if _checksum(latents, embedding) != self.checksums[index]:
            folder = self.sealed.file.parent
            raise InputError(f"{folder}: the features of frame {index} are damaged; {_REMEDY}")
        return torch.from_numpy(latents), torch.from_numpy(embedding)


def _checksum(
    latents: Float16[np.ndarray, "2 2 z h w"], embedding: Float16[np.ndarray, "2 d"]
) -> int:
    return zlib.crc32(embedding.data, zlib.crc32(latents.data))
