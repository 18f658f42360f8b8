"""Captures: images of a dynamic scene with camera poses, masks, depth and sparse points."""
