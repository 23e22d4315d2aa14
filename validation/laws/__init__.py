"""Checks of anyone's plugins: the laws of BSDFs, shapes and emitters, and every plugin of a scene."""
