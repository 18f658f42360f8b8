"""The bridge between torch and Warp: launches, streams, graphs, profiling, checks."""
