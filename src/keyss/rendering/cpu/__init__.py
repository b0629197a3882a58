"""The rasterizer for the CPU: numba kernels behind one torch.autograd.Function."""
