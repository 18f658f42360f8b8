"""The trained scene: static and dynamic Gaussians, the two networks, and corrections of camera poses."""
