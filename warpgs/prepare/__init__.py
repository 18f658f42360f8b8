"""From a video or a folder of frames to a capture: frames, cameras, masks, depth."""
