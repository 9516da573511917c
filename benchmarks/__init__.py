"""Comparisons: of whole methods in tables, and of our kernels with plain reference
implementations."""
