"""Images and videos of a trained scene: camera paths, keyframes, MP4."""
