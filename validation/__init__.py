"""Checks of the renderer against independent references."""
