"""``warpgs bench``: render times, training step times and playback frame rates."""
