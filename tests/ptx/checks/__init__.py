"""Checks of the CUDA kernels against the CPU; each takes a queue, of the interpreter or of a GPU."""
