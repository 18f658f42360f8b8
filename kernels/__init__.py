"""Warp kernels, installed as ``warpgs.kernels`` and launched by ``warpgs.ops``.

The first parameter of every kernel is ``first``, the index of the launch's first thread, so that a launch can be split
into shards that run on several CPU cores at once.
"""
