"""Preparation of input images: checks, grey, half size."""
