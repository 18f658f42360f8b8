"""warpgs: SplitGaussian, dynamic scenes from one moving camera, on NVIDIA Warp kernels."""
