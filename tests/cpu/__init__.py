"""The CPU's kernels run by the interpreter: the same source as plain Python, every access checked."""
