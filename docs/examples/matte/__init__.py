"""The plugin ``matte``; ``register()`` makes it known to Mitsuba."""

from __future__ import annotations

from mrt_mitsuba.plugins import register_modules


def register() -> None:
    """Register in this variant, and in every one switched to later."""
    register_modules(__name__, ["bsdf"])
