"""Flaws in the CUDA kernels, and how they are planted; ``python -m ptx.mutants`` prints the table."""
