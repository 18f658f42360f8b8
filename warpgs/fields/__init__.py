"""Networks over position and time."""
