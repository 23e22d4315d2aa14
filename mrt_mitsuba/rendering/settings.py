"""What a render is asked to do: the options of ``mrt.render``, checked; the command adds its own to them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.options import (
    anything,
    checked,
    choice,
    integer,
    number,
    option,
    parameters,
    rectangle,
    size,
    subset,
    switch,
    vector,
    word,
)
from mrt_mitsuba.output.layers import LAYERS
from mrt_mitsuba.rendering.detectors import DETECTORS
from mrt_mitsuba.scene.model import SIZE

LARGEST_SIDE = 65536  # pixels; whether the memory suffices is checked where it is planned
LARGEST_AA = 64  # 4096 samples per pixel; beyond, float32 sums lose more than more samples gain


@dataclass(frozen=True)
class Focus:
    """What is sharp, in scene units."""

    distance: float | None  #: from the camera; None for no depth of field
    range: float  #: half-width of the sharp zone around it


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """The options of a render, each checked when it is given. None: the scene or the machine decides.

    Raises ``UsageError`` for a value of the wrong type or range.
    """

    width: int | None = option(
        None, integer(1, LARGEST_SIDE), f"image width in pixels, up to {LARGEST_SIDE}", str(SIZE[0])
    )
    height: int | None = option(
        None, integer(1, LARGEST_SIDE), f"image height in pixels, up to {LARGEST_SIDE}", str(SIZE[1])
    )
    aa: int = option(
        4, integer(1, LARGEST_AA), f"anti-aliasing: aa x aa samples per pixel, up to {LARGEST_AA}"
    )
    aamode: str = option(
        "sobel",
        choice("none", *DETECTORS),
        "refine every pixel, or only edges in brightness (luma, sobel) or in shape (geometry)",
    )
    lattice: str = option(
        "report", choice("report", "centered"), "samples from the pixel centre on, or around it"
    )
    fresnel: str | None = option(None, choice("schlick", "dielectric"), "reflectance formula", "schlick")
    focaldist: float | None = option(
        None, number(0), "distance in focus, from the camera; 0: no depth of field", "from the scene"
    )
    focalrange: float | None = option(
        None, number(0), "half-width of the sharp zone around it", "from the scene"
    )
    dof: str = option(
        "report", choice("report", "corrected"), "depth of field as in the report, or without its flaws"
    )
    layers: tuple[str, ...] = option(
        (), subset(LAYERS), f"further EXR layers: all, or some of {', '.join(LAYERS)}", "none"
    )
    motion: tuple[float, float, float] | None = option(
        None, vector("DX,DY,DZ"), "motion blur: how far the camera moves", "none"
    )
    motionsamples: int = option(16, integer(1, 65536), "moments at which motion blur sees the scene")
    motionmode: str = option(
        "frames", choice("frames", "stratified"), "motion blur: a render for each moment, or one for all"
    )
    convention: str = option(
        "report", choice("report", "standard"), "MTL files: Ni is the roughness, or the IOR"
    )
    variant: str | None = option(None, word(), "Mitsuba variant", "llvm_ad_rgb, without LLVM scalar_rgb")
    memory: int | None = option(
        None, size(), "memory to stay within: a number, with K, M, G or T for a unit", "half of what is free"
    )
    seed: int = option(0, integer(0, 2**32 - 1), "seed where anything is random")
    integrator: object = option(None, anything())
    spp: int = option(1, integer(1, 65536), "rays for each sample, where the integrator is random")
    count_rays: bool = option(False, switch())
    params: Mapping[str, Any] | None = option(None, parameters())
    region: tuple[int, int, int, int] | None = option(None, rectangle())

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if "kind" in field.metadata:
                object.__setattr__(self, field.name, checked(field, getattr(self, field.name)))

    @classmethod
    def of(cls, **options: Any) -> RenderSettings:
        """Return the settings for options as Python gives them: a list for a tuple, "4G" for bytes."""
        return cls(**options)

    def focus(self, distance: float | None, reach: float) -> Focus:
        """Return the focus, in a scene that suggests ``distance`` and ``reach``; 0 turns it off."""
        distance = distance if self.focaldist is None else self.focaldist
        return Focus(distance or None, reach if self.focalrange is None else self.focalrange)

    def in_force(self, **decided: Any) -> dict[str, Any]:
        """Return the options that shape the picture, by name, with those that the scene ``decided``."""
        names = (*(name for name in TABLE if name != "memory"), "params", "region")
        values = {name: getattr(self, name) for name in names} | decided
        return {name: value for name, value in values.items() if value is not None}


#: The options of a render by name, without those that only Python can give
TABLE = {field.name: field for field in dataclasses.fields(RenderSettings) if field.metadata["help"]}


def check(name: str, value: Any) -> Any:
    """Return a value of the option ``name`` as ``RenderSettings`` holds it; raise ``UsageError``."""
    if name not in TABLE:
        raise UsageError(f"unknown option {name!r}")
    return checked(TABLE[name], value)
