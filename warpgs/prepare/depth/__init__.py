"""Inverse depth of every frame."""
