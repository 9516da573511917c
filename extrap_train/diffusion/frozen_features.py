"""What a model's frozen networks, the VAE's encoder and CLIP, say of prepared frames."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict

import torch
from jaxtyping import Float16, UInt8
from torch import Tensor
from torch.nn import functional

from extrap_train.config import ModelConfig
from extrap_train.data.feature_files import FrameEncoder
from extrap_train.device import single_precision
from extrap_train.diffusion.encoders import ClipImageEncoder, KlAutoencoder
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError


def has_frozen_networks(config: ModelConfig) -> bool:
    """Whether all that encodes photographs for a model is frozen, so that it can be cached."""
    return config.vae is not None and config.clip is not None


def frame_encoder(model: ExtrapolationModel) -> FrameEncoder:
    """The identity of a model's frozen networks: their weights, and what weights do not show.

    Reads all of the weights once, which takes a second or two at full size.
    """
    config = model.config
    assert config.vae is not None
    assert config.clip is not None
    digest = hashlib.sha256(json.dumps([asdict(config.vae), asdict(config.clip)]).encode())
    for name, weight in _weights(model):
        digest.update(f"{name} {tuple(weight.shape)}".encode())
        digest.update(weight.detach().to("cpu", torch.float32).contiguous().numpy().data)
    return FrameEncoder(digest.hexdigest(), config.image_size)


def _weights(model: ExtrapolationModel) -> Iterator[tuple[str, Tensor]]:
    """Those that take part in encoding."""
    vae, clip = model.parts()["vae"], model.parts()["image_encoder"]
    for part, network in (("vae", vae.encoder), ("vae", vae.quant_conv), ("clip", clip)):
        yield from ((f"{part}.{name}", x) for name, x in sorted(network.state_dict().items()))


@torch.inference_mode()
def encode_frames(
    model: ExtrapolationModel, images: UInt8[Tensor, "n 3 h w"]
) -> tuple[Float16[Tensor, "n 2 2 z p q"], Float16[Tensor, "n 2 d"]]:
    """Latents (mean and spread of the posterior) and embeddings of frames, in both orientations.

    As a training step computes them, but in single precision whatever that computes in: reduced to
    the model's size, then encoded. Half precision keeps 11 bits of each.
    """
    autoencoder, clip = model.autoencoder, model.image_encoder
    if not (isinstance(autoencoder, KlAutoencoder) and isinstance(clip, ClipImageEncoder)):
        raise InputError(f"model={model.config.name} has no frozen networks; leave it out")
    both = torch.stack([images, images.flip(-1)], 1).flatten(0, 1).float().div_(255)
    small = functional.avg_pool2d(both, both.shape[-1] // model.config.image_size)
    with single_precision(images.device):
        latents = torch.stack(autoencoder.posterior(small), 1)
        embeddings = clip(small)
    # What half precision cannot hold is far outside of what any decoder has seen.
    most = torch.finfo(torch.float16).max
    return (
        latents.clamp(-most, most).half().unflatten(0, (-1, 2)),
        embeddings.half().unflatten(0, (-1, 2)),
    )
