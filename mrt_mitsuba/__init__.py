"""A Whitted-style ray tracer with a Beckmann material, built from Mitsuba 3 plugins in Dr.Jit."""

from __future__ import annotations

import os as _os

__version__ = "0.1.0"

if not _os.path.isdir(_os.path.join(_os.path.dirname(__file__), "plugins")):
    # A source checkout: plugins and the like are folders beside this one.
    from mrt_mitsuba import _checkout

    _checkout.install()
