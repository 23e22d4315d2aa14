"""Choices that a scene makes where no option does."""

from __future__ import annotations

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.rays.lattice import FILM
from mrt_mitsuba.rendering.plan import RenderFacts
from mrt_mitsuba.rendering.settings import MAX_SPP, MIN_SPP, NOISE, RenderSettings


def decided(settings: RenderSettings, facts: RenderFacts) -> RenderSettings:
    """Return the settings in force: someone's own scene is rendered as Mitsuba renders it, the report's
    scenes as the report does.

    Raises ``UsageError`` for options that do not go together.
    """
    film, aamode = facts.film, settings.aamode
    _check_rounds(settings)
    if facts.whole:
        _check_whole(settings, facts)
    # Mitsuba's integrators draw random numbers for every ray, and their noise would pass for edges
    plain = (film is not None or facts.whole) and facts.random and settings.aa is None
    if aamode is None:
        aamode = NOISE if settings.rmse is not None else "none" if plain or facts.whole else "sobel"
    lattice = settings.lattice or (FILM if film or facts.whole or aamode == NOISE else "report")
    aa = settings.aa or (1 if aamode == NOISE or (plain and aamode == "none") else 4)
    spp = settings.spp or (film.rays if film and plain and settings.aamode is None else 1)
    most = settings.maxspp or (MAX_SPP if settings.rmse is not None else None)
    settings = settings.but(aa=aa, aamode=aamode, lattice=lattice, spp=spp, maxspp=most)
    if aamode == NOISE and settings.rmse is None and spp < MIN_SPP:
        raise UsageError(
            f"aamode=noise: give the mean of a pixel's rays as spp, {MIN_SPP} or more, or a target"
        )
    return settings


def _check_whole(settings: RenderSettings, facts: RenderFacts) -> None:
    """Raise ``UsageError`` for options that need single rays from the camera."""
    given = {
        f"aamode={settings.aamode}": settings.aamode not in (None, "none", NOISE),
        f"lattice={settings.lattice}": settings.lattice not in (None, FILM),
        "motion": settings.motion is not None,
        f"focaldist={facts.focus.distance}": facts.focus.distance is not None,
    }
    wrong = next((name for name, is_given in given.items() if is_given), None)
    if wrong is not None:
        way = "write focaldist=0" if wrong.startswith("focaldist") else "leave it out"
        raise UsageError(
            f"{wrong}: the integrator {facts.integrator} gives whole pictures, and no single rays; "
            f"{way}, or choose another, such as path"
        )


def _check_rounds(settings: RenderSettings) -> None:
    """Raise ``UsageError`` for options that rounds do not heed, and for those that nothing else heeds."""
    if settings.rmse is None and settings.aamode != NOISE:
        names = ("maxspp", "maxseconds", "on_round")
        given = next((name for name in names if getattr(settings, name) is not None), None)
        if given is not None:
            raise UsageError(f"{given} is of use only where rays go in rounds: with target or aamode=noise")
        return
    rounds = "aamode=noise" if settings.rmse is None else f"target={settings.rmse:g}"
    if settings.rmse is not None and settings.aamode not in (None, NOISE):
        raise UsageError(f"{rounds} with aamode={settings.aamode}: leave one of them out")
    if settings.rmse is not None and settings.spp is not None:
        raise UsageError(f"{rounds} with spp={settings.spp}: leave one of them out, or bound it by maxspp")
    if settings.aa is not None:
        raise UsageError(f"{rounds} with aa={settings.aa}: rounds decide it; leave one of them out")
    if settings.lattice not in (None, FILM):
        raise UsageError(
            f"{rounds} with lattice={settings.lattice}: rounds follow the film; leave lattice out"
        )
    if settings.region is not None:
        raise UsageError(f"{rounds} with region: rounds share the rays out over the whole picture")
