"""The category model: conditioning, denoiser, training and sampling (paper II-B)."""
