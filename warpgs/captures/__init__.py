"""Captures as a whole: ``warpgs check`` and ``warpgs import``."""
