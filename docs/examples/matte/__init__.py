"""The plugin ``matte``; ``register()`` makes it known to Mitsuba."""

from __future__ import annotations

from mrt_mitsuba import plugins

MATTE = plugins.Plugin("matte", "bsdf", "Matte", "bsdf", package=__name__)


def register() -> None:
    """Register in this variant, and in every one switched to later."""
    plugins.register([MATTE])
