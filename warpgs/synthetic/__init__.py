"""The built-in captures, ray-traced: what is in them, how they are written and where they are kept."""
