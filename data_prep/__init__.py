"""Data preparation: sequences in, pairs out; and the synthetic sequences themselves."""
