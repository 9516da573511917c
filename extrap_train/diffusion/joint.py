"""Several views of one scene denoised together: each one's tokens attend to those of the others.

Every self-attention of the denoiser looks at the tokens of a whole group of views instead of one
view's, as CAT3D's do (Gao et al. 2024); the small model has it at 4² latents, Stable Diffusion's
UNet at 32² and coarser. No weight is added, so a model of single views and one of groups start from
each other, and a group of one is a single view.
"""

from diffusers.models.attention_processor import Attention, AttnProcessor2_0
from jaxtyping import Float
from torch import Tensor


class JointAttention(AttnProcessor2_0):
    """Attention within groups of `joint_views` consecutive views.

    Which view is which it does not know: permuting a group permutes what comes out.
    """

    def __call__(
        self,
        attn: Attention,
        hidden_states: Float[Tensor, "b n c"],
        encoder_hidden_states: Float[Tensor, "b m d"] | None = None,
        attention_mask: Tensor | None = None,
        temb: Tensor | None = None,
        joint_views: int = 1,
    ) -> Float[Tensor, "b n c"]:
        """diffusers' hook: cross-attention, to each view's own token, stays as it is."""
        if encoder_hidden_states is not None or joint_views == 1:
            return super().__call__(
                attn, hidden_states, encoder_hidden_states, attention_mask, temb
            )
        together = hidden_states.unflatten(0, (-1, joint_views)).flatten(1, 2)
        attended: Tensor = super().__call__(attn, together)
        return attended.view(hidden_states.shape)
