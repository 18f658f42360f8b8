"""``warpgs bench``: times of renders, training steps and playback."""
