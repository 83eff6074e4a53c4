"""Kernels for a GPU, written from the same elementwise functions and in the same words."""
