"""Differentiable operations on torch tensors, each run by the Warp kernels of the same name in ``warpgs.kernels``."""
