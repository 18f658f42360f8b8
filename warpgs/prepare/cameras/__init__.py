"""Structure from motion with COLMAP: cameras and sparse points, and dense triangulation with known cameras."""
