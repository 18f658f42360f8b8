"""Training views on the device, or read from disk while a step runs."""
