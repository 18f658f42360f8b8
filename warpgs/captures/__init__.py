"""Captures as a whole: opened by folder, built-in name or config; ``warpgs check`` and ``warpgs import``."""
