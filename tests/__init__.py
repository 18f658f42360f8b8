import warpgs  # noqa: F401  before torch, see there
