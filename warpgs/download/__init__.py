"""Public captures, downloaded as their authors released them."""
