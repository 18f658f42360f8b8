"""Dataset loaders, one file for each layout."""
