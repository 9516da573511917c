"""Images to latents and back. The small model's latents are pixels: no network, no loss."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


@runtime_checkable
class Autoencoder(Protocol):
    """What the denoiser needs to know of its latent space."""

    channels: int
    factor: int
    """Image pixels a side of one latent."""

    def encode(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h2 w2"]:
        """Latents, of about unit spread, of images in [0, 1]."""
        ...

    def decode(self, latent: Float[Tensor, "b c h2 w2"]) -> Float[Tensor, "b 3 h w"]:
        """Images, not clamped, of latents."""
        ...


class PixelPatches:
    """Square patches of pixels as channels: exact both ways.

    The gain brings natural images (spread about 0.25 around mid-grey) to the unit spread that the
    noise schedule is made for.
    """

    gain = 4.0

    def __init__(self, patch: int) -> None:
        self.factor = patch
        self.channels = 3 * patch * patch

    def encode(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h2 w2"]:
        """See `Autoencoder.encode`."""
        return functional.pixel_unshuffle((image - 0.5) * self.gain, self.factor)

    def decode(self, latent: Float[Tensor, "b c h2 w2"]) -> Float[Tensor, "b 3 h w"]:
        """See `Autoencoder.decode`."""
        return functional.pixel_shuffle(latent, self.factor) / self.gain + 0.5
