"""One HTML file about one or several runs: curves, figures of every view, pictures, timing."""
