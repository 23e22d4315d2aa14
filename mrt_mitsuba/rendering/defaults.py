"""Choices that a scene makes where no option does."""

from __future__ import annotations

from dataclasses import replace

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.rays.lattice import FILM
from mrt_mitsuba.rendering.plan import RenderFacts
from mrt_mitsuba.rendering.settings import MIN_SPP, NOISE, RenderSettings


def decided(settings: RenderSettings, facts: RenderFacts) -> RenderSettings:
    """Return the settings in force: someone's own scene is rendered as Mitsuba renders it, the report's
    scenes as the report does.

    Raises ``UsageError`` for options that do not go together.
    """
    film, aamode = facts.film, settings.aamode
    # Mitsuba's integrators draw random numbers for every ray, and their noise would pass for edges
    plain = film is not None and facts.random and settings.aa is None
    if aamode is None:
        aamode = NOISE if settings.rmse is not None else "none" if plain else "sobel"
    lattice = settings.lattice or (FILM if film else "report")
    if facts.variant.startswith("scalar") and lattice == FILM and not settings.lattice:
        lattice = "centered"
    aa = settings.aa or (1 if aamode == NOISE or (plain and aamode == "none") else 4)
    spp = settings.spp or (film.rays if film and plain and settings.aamode is None else 1)
    settings = replace(settings, aa=aa, aamode=aamode, lattice=lattice, spp=spp)
    _check(settings, facts)
    return settings


def _check(settings: RenderSettings, facts: RenderFacts) -> None:
    if settings.lattice == FILM and facts.variant.startswith("scalar"):
        raise UsageError("lattice=film needs arrays of rays: choose variant=llvm_ad_rgb")
    if settings.rmse is not None and settings.aamode != NOISE:
        raise UsageError(f"target={settings.rmse:g} with aamode={settings.aamode}: leave one of them out")
    if settings.aamode != NOISE:
        return
    if settings.lattice != FILM and facts.random:
        raise UsageError(f"aamode=noise: a random integrator needs lattice=film, not {settings.lattice}")
    if settings.lattice != FILM and settings.motion and settings.motionmode == "frames":
        raise UsageError(
            "aamode=noise: the frames of motionmode=frames have errors of their own; choose stratified"
        )
    if settings.rmse is None and settings.lattice != FILM:
        raise UsageError("aamode=noise: without random numbers, give the error to reach as target=")
    if settings.rmse is None and (settings.spp or 1) < MIN_SPP:
        raise UsageError(
            f"aamode=noise: give the mean of a pixel's rays as spp, {MIN_SPP} or more, or a target"
        )
