"""Data sets: frames with ground truth, splits, published figures."""
