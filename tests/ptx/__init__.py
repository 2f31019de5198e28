"""The proof of the CUDA kernels without a GPU: their PTX is executed on the CPU, assembled and counted."""
