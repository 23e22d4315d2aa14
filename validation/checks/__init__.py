"""Checks of anyone's plugins: the laws of a BSDF and of a shape, and every plugin of a scene."""
