"""Warp kernels, installed as ``warpgs.kernels``. They launch nothing: ``warpgs.ops`` does.

Every kernel takes ``first`` as its first parameter, the index of the launch's first thread, so that a launch can be
cut into shards that run on several CPU cores at once.
"""
