"""Evaluation on held-out views: metrics and LPIPS."""
