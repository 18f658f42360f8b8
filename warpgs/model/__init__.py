"""The trained scene: static and dynamic Gaussians and the two networks."""
