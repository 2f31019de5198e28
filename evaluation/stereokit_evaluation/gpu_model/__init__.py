"""Modelled times of kernels on GPUs."""
