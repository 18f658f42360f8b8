"""Files of Gaussians, as other programs write and read them."""
