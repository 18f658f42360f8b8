"""From a video of one's own to a capture: frames, cameras, masks, depth; and the check of any capture."""
