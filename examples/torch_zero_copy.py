"""Torch tensors in and out without a copy (``stereokit[train]``, or any torch on the CPU).

A CPU tensor and a numpy array can be two names of one memory. A matcher never writes to its input, and each result
has memory of its own, so both directions are safe.
"""

import numpy as np
import torch

import stereokit

generator = torch.Generator().manual_seed(0)
left = torch.randint(0, 256, (120, 320), dtype=torch.uint8, generator=generator)
right = torch.roll(left, -9, dims=1)  # every pixel moves nine to the left

matcher = stereokit.Matcher("S2", max_disparity=32)
result = matcher(left.numpy(), right.numpy())  # .numpy() looks at the tensor's memory
disparity = torch.from_numpy(result.disparity)  # and this tensor at the result's
valid = torch.from_numpy(result.valid)

assert np.shares_memory(left.numpy(), np.asarray(left))
assert disparity.data_ptr() == result.disparity.ctypes.data
print(f"{tuple(disparity.shape)} {disparity.dtype}, median {disparity[valid].median():.1f} px, no copy")

# Grey uint8 or uint16 in row order is used as it is; colour is turned into grey, which is a new array, and a
# channel-first (3, H, W) tensor is given as left.permute(1, 2, 0).numpy().
