"""Readers of the files in which networks leave tracks, depth and masks of the frames of one camera."""
