"""Every setting that trades error for time, as cases to run against a converged picture."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Mesh, Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies.depth_of_field import Lens, fit_lens

Render = Callable[..., Any]  # returns a ``Result``

MODES = ("none", "luma", "sobel", "geometry")
CUT_OFFS = (0.0, 1 / 16 / 255, 1 / 255, 4 / 255, 16 / 255)
DEPTHS = (1, 2, 3, 5, 10)
SEGMENTS = (8, 32, 128, 512)


@dataclass(frozen=True)
class Trade:
    """Settings of one kind on one scene, and the picture they strive for.

    ``reference`` and ``check``: two renders of the truth, the better one first; what they differ by bounds
    the error of the first.
    """

    scene: str
    name: str
    title: str
    truth: str  # what the reference is
    reference: Render
    check: Render
    cases: Mapping[str, Render]


@dataclass(frozen=True)
class Extent:
    """How far the settings go."""

    size: tuple[int, int]
    amounts: Sequence[int]  # aa
    reference_aa: int
    spp: Sequence[int]
    reference_spp: int


def load(scene: dict[str, Any]) -> Any:
    """A Mitsuba scene of a dict with our plugins."""
    import mitsuba as mi

    mrt.register()
    return mi.load_dict(scene)


def sampling(number: int, extent: Extent) -> Trade:
    """Which pixels get how many samples, and where in the pixel."""
    scene = _scene(number, extent)
    cases = {
        f"{mode} aa={aa} {lattice}": partial(mrt.render, scene, aa=aa, aamode=mode, lattice=lattice)
        for lattice in ("report", "centered")
        for mode in MODES
        for aa in extent.amounts
        if aa > 1 or mode == "none"
    }
    truth = partial(mrt.render, scene, aamode="none", lattice="centered")
    return Trade(
        str(number),
        "sampling",
        "anti-aliasing mode, aa and lattice",
        f"{extent.reference_aa}x{extent.reference_aa} centered samples in every pixel",
        partial(truth, aa=extent.reference_aa),
        partial(truth, aa=extent.reference_aa * 3 // 4),
        cases,
    )


def whitted(number: int, extent: Extent) -> Trade:
    """Cut-off, bounce limit and form of the Fresnel factor, at the same samples."""
    scene, exact = _scene(number, extent), _scene(number, extent, fresnel="dielectric")
    shared: dict[str, Any] = {"aa": 2, "aamode": "none"}

    def integrator(**parameters: Any) -> Any:
        return {"type": "mrt_whitted", **parameters}

    cases = {
        f"min_contribution={255 * c:g}/255": partial(
            mrt.render, exact, **shared, integrator=integrator(min_contribution=c)
        )
        for c in CUT_OFFS
    }
    cases |= {
        f"max_depth={d}": partial(mrt.render, exact, **shared, integrator=integrator(max_depth=d))
        for d in DEPTHS
    }
    cases["fresnel=schlick"] = partial(mrt.render, scene, **shared)
    truth = partial(mrt.render, exact, **shared, integrator=integrator(min_contribution=0.0))
    return Trade(
        str(number),
        "whitted",
        "cut-off, bounce limit, Fresnel form",
        "no cut-off, max_depth=10, exact Fresnel",
        truth,
        truth,
        cases,
    )


def path(number: int, extent: Extent) -> Trade:
    """Mitsuba's path and direct at rising spp, and mrt_whitted, against converged path."""
    scene = _scene(number, extent)
    shared: dict[str, Any] = {"aa": 1, "aamode": "none"}
    cases = {
        f"{kind} spp={spp}": partial(mrt.render, scene, **shared, integrator=kind, spp=spp)
        for kind in ("path", "direct")
        for spp in extent.spp
    }
    cases["mrt_whitted"] = partial(mrt.render, scene, **shared)
    cases["mrt_whitted, no clamp"] = partial(
        mrt.render, scene, **shared, integrator={"type": "mrt_whitted", "clamp": False}
    )
    truth = partial(mrt.render, scene, **shared, integrator="path")
    return Trade(
        str(number),
        "path",
        "Whitted, direct and path at rising spp, against converged path",
        f"path with spp={extent.reference_spp}",
        partial(truth, spp=extent.reference_spp, seed=101),
        partial(truth, spp=extent.reference_spp, seed=202),
        cases,
    )


def lens(number: int, extent: Extent) -> Trade:
    """Both depth-of-field filters, and a thin lens at rising spp."""
    width, height = extent.size
    scene = report_scene(number)
    shared: dict[str, Any] = {"aa": 2, "aamode": "none", "lattice": "centered"}
    sharp = mrt.render(_scene(number, extent), **shared, layers=["depth"])
    found: Lens = fit_lens(scene, sharp.layers["depth.Z"])
    description = scene.to_dict(width=width, height=height)
    description["sensor"] |= {
        "type": "thinlens",
        "aperture_radius": found.radius,
        "focus_distance": found.focus,
    }
    through = load(description)
    cases = {
        f"filter {dof}": partial(mrt.render, number, width=width, height=height, **shared, dof=dof)
        for dof in ("report", "corrected")
    }
    cases |= {
        f"thinlens spp={4 * spp}": partial(mrt.render, through, **shared, spp=spp) for spp in extent.spp
    }
    truth = partial(mrt.render, through, **shared, spp=extent.reference_spp // 4)  # of four samples
    return Trade(
        str(number),
        "lens",
        "depth of field as a filter and through a lens",
        f"a lens fitted to the report's blur, {extent.reference_spp} rays a pixel",
        partial(truth, seed=101),
        partial(truth, seed=202),
        cases,
    )


def cone(extent: Extent) -> Trade:
    """The cone of scene 9 as triangles, against the analytic one."""
    scene = report_scene(9)
    width, height = extent.size
    shared: dict[str, Any] = {"aa": 2, "aamode": "none"}
    cases = {
        f"{n} segments": partial(
            mrt.render, load(meshed(scene, n).to_dict(width=width, height=height)), **shared
        )
        for n in SEGMENTS
    }
    truth = partial(mrt.render, _scene(9, extent), **shared)
    return Trade(
        "9",
        "cone",
        "cone segments against the analytic cone",
        "the analytic cone",
        truth,
        truth,
        {**cases, "analytic": truth},
    )


def meshed(scene: Scene, segments: int) -> Scene:
    """The scene with its cones as flat triangles, ``segments`` around, and closed below."""
    return dataclasses.replace(scene, cones=(), meshes=tuple(_cone_mesh(c, segments) for c in scene.cones))


def _cone_mesh(cone: Any, segments: int) -> Mesh:
    apex, base = np.array(cone.apex, float), np.array(cone.base_center, float)
    axis = (apex - base) / np.linalg.norm(apex - base)
    s = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    s /= np.linalg.norm(s)
    t = np.cross(axis, s)
    angle = 2 * math.pi * np.arange(segments) / segments
    rim = base + cone.radius * (np.cos(angle)[:, None] * s + np.sin(angle)[:, None] * t)
    i = np.arange(segments)
    j = (i + 1) % segments
    side = np.stack([i, j, np.full(segments, segments)], axis=1)
    bottom = np.stack([j, i, np.full(segments, segments + 1)], axis=1)
    vertices = np.concatenate([rim, apex[None], base[None]]).astype(np.float32)
    return Mesh(vertices, np.concatenate([side, bottom]).astype(np.uint32), cone.material)


def _scene(number: int, extent: Extent, fresnel: str = "schlick") -> Any:
    width, height = extent.size
    return load(mrt.scene_dict(number, width=width, height=height, fresnel=fresnel))
