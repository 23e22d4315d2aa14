"""Every setting of ours that trades error for time, as cases for ``error_vs_time``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies.depth_of_field import fit_lens

MODES = ("none", "luma", "sobel", "geometry")
CUT_OFFS = (0.0, 1 / 16 / 255, 1 / 255, 4 / 255, 16 / 255)
DEPTHS = (1, 2, 3, 5, 10)

Options = dict[str, Any]


@dataclass(frozen=True)
class Trade:
    """Settings of one kind on one scene, and the picture they strive for: arguments of ``error_vs_time``."""

    scene: Any
    title: str
    truth: str  # what the reference is
    cases: Mapping[str, Options]
    reference: Any
    shared: Options


@dataclass(frozen=True)
class Extent:
    """How far the settings go."""

    size: tuple[int, int]
    amounts: Sequence[int]  # aa
    reference_aa: int  # an even multiple of each: at an odd one, lattices share samples and with them errors
    spp: Sequence[int]
    reference_spp: int

    def scene(self, number: int, **options: Any) -> Options:
        """Return a scene of the report as a dict, of the extent's size."""
        return mrt.scene_dict(number, width=self.size[0], height=self.size[1], **options)


def load(scene: Options) -> Any:
    """Return a Mitsuba scene of a dict with our plugins."""
    mrt.register()
    return mi.load_dict(scene)


def sampling(number: int, extent: Extent) -> Trade:
    """Return which pixels get how many samples, and where in the pixel."""
    most = extent.reference_aa
    return Trade(
        extent.scene(number),
        "anti-aliasing mode, aa and lattice",
        f"{most}x{most} centered samples in every pixel; its error: what three quarters of {most} change",
        {
            f"{mode} aa={aa} {lattice}": {"aa": aa, "aamode": mode, "lattice": lattice}
            for lattice in ("report", "centered")
            for mode in MODES
            for aa in extent.amounts
            if aa > 1 or mode == "none"
        },
        [{"aa": aa, "aamode": "none", "lattice": "centered"} for aa in (most, most * 3 // 4)],
        {},
    )


def whitted(number: int, extent: Extent) -> Trade:
    """Return cut-off, bounce limit and form of the Fresnel factor, at the same samples."""

    def integrator(**parameters: Any) -> Options:
        return {"integrator": {"type": "mrt_whitted", **parameters}}

    cases = {f"min_contribution={255 * c:g}/255": integrator(min_contribution=c) for c in CUT_OFFS}
    cases |= {f"max_depth={depth}": integrator(max_depth=depth) for depth in DEPTHS}
    return Trade(
        extent.scene(number, fresnel="dielectric"),
        "cut-off, bounce limit, Fresnel form",
        "no cut-off, max_depth=10, exact Fresnel, the same rays",
        {**cases, "fresnel=schlick": {"scene": extent.scene(number)}},
        integrator(min_contribution=0.0),
        {"aa": 2, "aamode": "none", "lattice": "report"},
    )


def path(number: int, extent: Extent) -> Trade:
    """Return Mitsuba's path and direct at rising spp, and mrt_whitted, against converged path."""
    cases: dict[str, Options] = {
        f"{kind} spp={spp}": {"integrator": kind, "spp": spp}
        for kind in ("path", "direct")
        for spp in extent.spp
    }
    cases["mrt_whitted"] = {}
    cases["mrt_whitted, no clamp"] = {"integrator": {"type": "mrt_whitted", "clamp": False}}
    return Trade(
        extent.scene(number),
        "Whitted, direct and path at rising spp",
        f"path with spp={extent.reference_spp}",
        cases,
        {"integrator": "path", "spp": extent.reference_spp},
        {"aa": 1, "aamode": "none"},
    )


def lens(number: int, extent: Extent) -> Trade:
    """Return both depth-of-field filters, and a thin lens at rising spp."""
    width, height = extent.size
    shared: Options = {"aa": 2, "aamode": "none", "lattice": "centered"}
    sharp = mrt.render(load(extent.scene(number)), **shared, layers=["depth"])
    through = fit_lens(report_scene(number), sharp.layers["depth.Z"]).through(extent.scene(number))
    cases: dict[str, Options] = {
        f"filter {dof}": {"scene": number, "width": width, "height": height, "dof": dof}
        for dof in ("report", "corrected")
    }
    return Trade(
        through,
        "depth of field as a filter and through a lens",
        f"a lens fitted to the report's blur, {extent.reference_spp} rays a pixel",
        cases | {f"thinlens spp={4 * spp}": {"spp": spp} for spp in extent.spp},
        {"spp": extent.reference_spp // 4},  # of four samples
        shared,
    )


TRADES = {"sampling": sampling, "whitted": whitted, "path": path, "lens": lens}
