"""Scenes with exact ground truth: the streets of `scenes`, and the pairs of many kinds of `generated`."""
