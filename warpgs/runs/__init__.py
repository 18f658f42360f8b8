"""Run folders: config, checkpoints, and the trained scene in them."""
