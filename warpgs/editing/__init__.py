"""Edits of a trained scene: Gaussians that are removed before it is rendered, viewed or exported."""
