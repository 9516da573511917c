"""The denoising network: diffusers' conditional UNet, sized by the configuration."""

from diffusers import UNet2DConditionModel

from extrap_train.config import UNetConfig


def build_unet(
    config: UNetConfig, in_channels: int, out_channels: int, latent_size: int
) -> UNet2DConditionModel:
    """A randomly initialised UNet; its last layer starts at zero, so that training starts calm."""
    down = ["CrossAttnDownBlock2D" if level else "DownBlock2D" for level in config.attention_levels]
    up = ["CrossAttnUpBlock2D" if level else "UpBlock2D" for level in config.attention_levels[::-1]]
    unet = UNet2DConditionModel(
        sample_size=latent_size,
        in_channels=in_channels,
        out_channels=out_channels,
        block_out_channels=tuple(config.channels),
        layers_per_block=config.layers_per_block,
        down_block_types=tuple(down),
        up_block_types=tuple(up),
        cross_attention_dim=config.token_width,
        attention_head_dim=config.heads,  # diffusers' historical name for the number of heads
        norm_num_groups=config.norm_groups,
    )
    unet.conv_out.weight.data.zero_()
    unet.conv_out.bias.data.zero_()
    return unet
