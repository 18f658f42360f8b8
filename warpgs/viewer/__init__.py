"""A viewer in the browser: one thread renders for each browser that is connected."""
