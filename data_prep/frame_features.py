"""The step of a preparation that asks a model's frozen networks about every training frame once."""

from collections.abc import Callable, Sequence

import torch

from extrap_train.config import ModelConfig
from extrap_train.data.feature_files import FeatureFiles
from extrap_train.data.prepared import PreparedData
from extrap_train.device import fastest_device
from extrap_train.diffusion.frozen_features import encode_frames, frame_encoder
from extrap_train.diffusion.model import ExtrapolationModel, use_channels_last
from extrap_train.diffusion.model_files import initial_model
from extrap_train.terminal import progress

_AT_ONCE = 8
"""Frames that are encoded together, each in both orientations."""


def encode_members(prepared: Sequence[PreparedData], config: ModelConfig) -> None:
    """Cache the features of all training frames for the model that `config` describes.

    What is cached already, of the same frames and networks, stays. Raises InputError where the
    model's weights cannot be used.
    """
    encode_with(use_channels_last(initial_model(config)), prepared)


def encode_with(model: ExtrapolationModel, prepared: Sequence[PreparedData]) -> None:
    """`encode_members` for a model that is there."""
    encoder = frame_encoder(model)
    for data in prepared:
        files = FeatureFiles(data, encoder)
        missing = files.missing()
        frames = sum(len(data.names(sequence)) for sequence in missing)
        with progress("encoding", frames, "frames", shown=bool(missing)) as bar:
            for sequence in missing:
                _encode_sequence(model, files, sequence, bar.advance)
        made = f"{frames} frames encoded" if frames else "frames were encoded before"
        print(f"{data.folder}: {made} for trainer.latents=cached")


def _encode_sequence(
    model: ExtrapolationModel, files: FeatureFiles, sequence: str, advance: Callable[[int], None]
) -> None:
    device, count = fastest_device(), len(files.data.names(sequence))
    parts = []
    for frames in torch.arange(count).split(_AT_ONCE):
        images = files.data.images(sequence, frames.tolist()).to(device)
        parts.append([x.cpu() for x in encode_frames(model, images)])
        advance(len(frames))
    latents, embeddings = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
    files.write(sequence, latents, embeddings)
