"""What is trained: Gaussians, static and dynamic, and the two networks."""
