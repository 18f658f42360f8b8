"""The built-in captures, and the ray tracer that renders them."""
