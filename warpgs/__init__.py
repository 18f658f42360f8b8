"""warpgs: SplitGaussian, dynamic scenes from one moving camera, on NVIDIA Warp kernels."""

import os

# On CPU torch's threads would spin after each of its operations, on the cores that Warp's kernels run on by then: an
# iteration takes a third longer, and many times as long where another program wants a core. torch reads this when it is
# imported, so import warpgs first.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
