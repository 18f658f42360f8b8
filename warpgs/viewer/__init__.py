"""A viewer in the browser; one thread renders for each connected browser."""
