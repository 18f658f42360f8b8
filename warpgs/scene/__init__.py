"""What a scene is made of: Gaussians, static and dynamic."""
