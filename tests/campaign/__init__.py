"""Fault campaigns: seeded, a few seconds by default, as long as wanted with ``--campaign N``."""
