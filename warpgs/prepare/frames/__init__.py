"""From a video or a folder to frames: decoded, chosen by time and sharpness, with the flow between them."""
