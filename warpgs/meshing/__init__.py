"""Triangle meshes of a scene: depth images, fused into signed distances, and the surfaces of these."""
