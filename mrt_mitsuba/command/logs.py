"""Logging for this package, Mitsuba and Dr.Jit."""

from __future__ import annotations

import logging
import warnings

from mrt_mitsuba.errors import MrtWarning

# From the fewest records to the most, as Python, Mitsuba and Dr.Jit call them
LEVELS = {
    "error": (logging.ERROR, "Error", "Error"),
    "warn": (logging.WARNING, "Warn", "Warn"),
    "info": (logging.INFO, "Info", "Warn"),
    "debug": (logging.DEBUG, "Debug", "Info"),  # with every kernel that is launched
}


def show(level: str) -> None:
    """Show records from ``level`` on, of this package, of Mitsuba (on standard output) and of Dr.Jit."""
    import drjit as dr
    import mitsuba as mi

    ours, mitsubas, drjits = LEVELS[level]
    logger = logging.getLogger("mrt_mitsuba")
    logger.setLevel(ours)
    if not logger.handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logger.addHandler(handler)
    mi.set_log_level(getattr(mi.LogLevel, mitsubas))
    dr.set_log_level(getattr(dr.LogLevel, drjits))
    if level == "error":
        warnings.simplefilter("ignore", MrtWarning)
