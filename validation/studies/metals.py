"""How far Schlick's formula is from the exact Fresnel term of the metals that Mitsuba brings."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mrt_mitsuba.validation.tools.bsdf_probe import interaction, rgb
from mrt_mitsuba.validation.tools.gallery import panels
from mrt_mitsuba.validation.tools.scenery import ball_scene, side_by_side
from mrt_mitsuba.validation.tools.study import Study

ANGLES = np.arange(0.0, 90.0)  # degrees
QUICK_PICTURE, PICTURE = (96, 32), (160, 256)  # size and samples per pixel
Array = NDArray[Any]


@dataclass(frozen=True)
class Metal:
    """A material preset: index and extinction per channel, and reflectances [angles, 3] at ``ANGLES``."""

    name: str
    eta: Array
    k: Array
    exact: Array
    schlick: Array

    @property
    def f0(self) -> Array:
        """Exact reflectance at normal incidence, [3]."""
        return f0_of_conductor(self.eta, self.k)

    @property
    def error(self) -> Array:
        """Schlick − exact, [angles, 3]."""
        return self.schlick - self.exact

    @property
    def worst(self) -> tuple[float, float]:
        """Largest error of a channel, and the angle in degrees where it is."""
        sizes = np.abs(self.error).max(axis=1)
        return float(sizes.max()), float(ANGLES[sizes.argmax()])

    @property
    def albedo_error(self) -> float:
        """Largest error of a channel under even light from everywhere: the mean over cos θ dω / π."""
        theta = np.radians(ANGLES)
        weight = np.sin(2 * theta)
        return float(np.abs((self.error * weight[:, None]).sum(axis=0) / weight.sum()).max())


def f0_of_conductor(eta: Array, k: Array) -> Array:
    """Return the reflectance at normal incidence from air: ((η − 1)² + k²) / ((η + 1)² + k²)."""
    return ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)


def preset_names() -> list[str]:
    """Return every material preset of this Mitsuba that ``roughconductor`` takes."""
    folder = Path(mi.__file__).parent / "data" / "ior"
    return sorted(path.name.removesuffix(".eta.spd") for path in folder.glob("*.eta.spd"))


def measure(name: str) -> Metal:
    """Compare a preset, with the indices per channel that ``roughconductor`` uses in the current RGB variant.

    Schlick's term is what ``mrt_bsdf`` gives to the mirror direction, with ``f0`` from the indices.
    """
    with _silent():
        parameters = mi.traverse(mi.load_dict({"type": "roughconductor", "material": name}))
    eta, k = (np.ravel(parameters[f"{key}.value"]).astype(float) for key in ("eta", "k"))
    bsdf = mi.load_dict({"type": "mrt_bsdf", "f0": rgb(f0_of_conductor(eta, k).tolist())})
    theta = np.radians(ANGLES)
    wi = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1)
    schlick = np.array(bsdf.eval_attribute("mirror_reflectance", interaction(wi))).T
    return Metal(name, eta, k, exact_reflectance(np.cos(theta), eta, k), schlick)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Silence Mitsuba about spectra without a colour in RGB: it takes the nearest."""
    before = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(before)


def exact_reflectance(cos_theta: Array, eta: Array, k: Array) -> Array:
    """Return Mitsuba's Fresnel term of conductors, [angles, channels]."""
    cosine = mi.Float(cos_theta)
    columns = [
        np.array(mi.fresnel_conductor(cosine, mi.Complex2f(float(n), float(x))))
        for n, x in zip(eta, k, strict=True)
    ]
    found = np.stack(columns, axis=-1)
    # In RGB, some channels of two compounds have neither index nor extinction: 0/0 along the normal, else 1
    undefined = (eta == 0) & (k == 0) & (cos_theta == 1)[:, None]
    return np.where(undefined, 1.0, found)


def run(study: Study, *, quick: bool) -> None:
    """Check every preset, with a table, a map over metal and angle, and a picture of the worst metal."""
    metals = sorted(map(measure, preset_names()), key=lambda metal: -metal.worst[0])
    _hold(study, metals)
    _tabulate(study, metals)
    caption = "The channel with the largest error. Red: Schlick is too bright. Worst at the top."
    study.plot("metals", f"Schlick − exact, {len(metals)} materials by angle", _map(metals), caption)
    title = f"The worst, {metals[0].name}: reflectance by angle"
    caption = "Solid: exact. Dashed: Schlick. The dip towards grazing angles is what Schlick lacks."
    study.plot("metals-worst", title, _curves(metals[0]), caption)
    show_ball(study, metals[0], quick)


def _hold(study: Study, metals: Sequence[Metal]) -> None:
    normal = np.max([np.abs(metal.error[0] / metal.exact[0]) for metal in metals])
    what = f"F₀ of {len(metals)} metals against the exact value, relative"
    study.at_most(what, normal, 1e-5, "the same number by two formulas, a few roundings")
    what = "Schlick against exact under even light, worst metal"
    why = "what its missing dip towards grazing angles costs, there where least light comes from"
    study.at_most(what, np.max([m.albedo_error for m in metals]), 0.05, why)
    study.record("Schlick against exact, worst metal and angle", metals[0].worst[0])
    study.record(
        "Schlick against exact, median over metals of the worst angle",
        np.median([m.worst[0] for m in metals]),
    )


def _tabulate(study: Study, metals: Sequence[Metal]) -> None:
    rows = [[m.name, *(float(x) for x in m.f0), m.worst[0], m.worst[1], m.albedo_error] for m in metals]
    columns = ["material", "F₀ red", "F₀ green", "F₀ blue", "largest error", "at °", "under even light"]
    note = "Errors are differences of reflectance, of the worst channel."
    study.table("metals", "Schlick against exact, by material", columns, rows, note)


def _map(metals: Sequence[Metal]) -> Any:
    figure, axes = panels(7, 2 + 0.12 * len(metals))
    signed = [np.take_along_axis(m.error, np.abs(m.error).argmax(axis=1)[:, None], 1)[:, 0] for m in metals]
    limit = max(np.abs(row).max() for row in signed)
    shown = axes.imshow(
        signed, aspect="auto", cmap="RdBu_r", vmin=-limit, vmax=limit, extent=(0, 90, len(metals), 0)
    )
    axes.set_yticks(np.arange(len(metals)) + 0.5, [m.name for m in metals], fontsize=6)
    axes.set(xlabel="angle of incidence [°]")
    figure.colorbar(shown, label="Schlick − exact")
    return figure


def _curves(metal: Metal) -> Any:
    figure, axes = panels(6, 4)
    for channel, color in enumerate(("tab:red", "tab:green", "tab:blue")):
        axes.plot(ANGLES, metal.exact[:, channel], color=color)
        axes.plot(ANGLES, metal.schlick[:, channel], color=color, linestyle="--")
    axes.set(xlabel="angle of incidence [°]", ylabel="reflectance", ylim=(0, 1.02))
    return figure


def show_ball(study: Study, metal: Metal, quick: bool) -> None:
    """Show a ball of the metal, both ways, and the difference."""
    size, spp = QUICK_PICTURE if quick else PICTURE
    common = {"alpha": 0.1}
    ours = {"type": "mrt_bsdf", "f0": rgb(metal.f0.tolist()), "diffuse_reflectance": 0.0, **common}
    theirs = {"type": "roughconductor", "material": metal.name, "distribution": "beckmann", **common}
    pictures = [np.array(mi.render(ball_scene(bsdf, size=size), spp=spp, seed=0)) for bsdf in (ours, theirs)]
    title = f"{metal.name}, where Schlick is worst: ours, Mitsuba's, |difference| × 5"
    caption = "A ball of roughness 0.1 under the path integrator."
    study.picture("metal", title, side_by_side(*pictures, gain=5), caption, exr=True)
