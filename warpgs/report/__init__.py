"""One HTML file about one or several runs: metrics, curves, images, timing."""
