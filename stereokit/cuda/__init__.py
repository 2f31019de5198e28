"""The GPU: its pipeline, kernels' common ground, streams and driver. Imported only where a GPU is asked for."""
