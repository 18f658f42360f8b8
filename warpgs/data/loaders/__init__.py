"""Dataset loaders, one file for each layout."""

from .nerfies import Dataset, load_capture, recognise

__all__ = ["Dataset", "load_capture", "recognise"]
