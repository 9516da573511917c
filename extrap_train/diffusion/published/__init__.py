"""Checkpoints of ZeroNVS and MegaScenes, as they were published, into diffusers' networks.

Both are latent-diffusion state dicts: `model.diffusion_model.*` (denoiser), `first_stage_model.*`
(autoencoder), `cond_stage_model.model.visual.*` (CLIP) and `cc_projection.*`. `names` says where
each tensor of ours lies in them; `read` finds and checks the files.
"""
