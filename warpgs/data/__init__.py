"""Captures: what a camera filmed, with poses, masks and depth."""
