"""The laws that ``mrt_bsdf`` must obey, and what is special to it: furnaces, known numbers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.scene.report import SCENE_4_MATERIALS
from mrt_mitsuba.validation.checks.bsdf import check_bsdf
from mrt_mitsuba.validation.tools.bsdf_probe import (
    albedo,
    at_angle,
    evaluate,
    largest,
    lobe_pairs,
    relative_error,
    rgb,
)
from mrt_mitsuba.validation.tools.study import Bound, Study

TITLE = "Laws of the BSDF: sampling, energy, reciprocity, gradients, known numbers"

KD, KS = (0.1, 0.3, 0.5), (0.5, 0.6, 0.2)


def colors(diffuse: Sequence[float], specular: Sequence[float]) -> dict[str, Any]:
    """Return the parameters of these reflectances."""
    return {"diffuse_reflectance": rgb(diffuse), "specular_reflectance": rgb(specular)}


COLORS = colors(KD, KS)
EXACT = {"fresnel": "dielectric"}
CHECKER = {"type": "checkerboard", "color0": 0.1, "color1": 0.6}

# What the laws are checked on: forms and roughnesses, ways to sample, textures
MATERIALS: dict[str, dict[str, Any]] = {
    "schlick": {**COLORS},
    "dielectric, rough, plain sampling": {**COLORS, **EXACT, "alpha": 0.4, "sample_visible": False},
    "narrow": {**COLORS, **EXACT, "alpha": 0.01},
    "unity, alpha 1": {"alpha": 1.0, "fresnel": "unity", "diffuse_reflectance": 0.0},
    "textured": {"alpha": CHECKER, "diffuse_reflectance": CHECKER, "specular_reflectance": 0.3},
    "negative": {"alpha": -0.3, "specular_reflectance": rgb((0.5, 0.3, 0.2)), "diffuse_reflectance": 0.0},
    "with f0": {"f0": rgb((0.9, 0.5, 0.1)), "diffuse_reflectance": 0.0, "alpha": 0.2},
}

# The limits of these laws leave room for anybody's BSDF; ours is held to some roundings, eight times what was
# measured
OWN = {"gradients": 1e-5, "weights": 2e-6, "variants": 2e-6}
OWN |= dict.fromkeys(("reciprocity", "eval_pdf", "components", "switch"), 1e-6)

# Albedos by angle that the tests of Nori give for a BSDF of this family, and its parameters
NORI = {0: 0.207067, 45: 0.215733, 60: 0.247884, 80: 0.430936, 85: 0.519016}
NORI_BSDF = {
    "alpha": 0.1,
    "int_ior": 1.5,
    "ext_ior": 1.000277,
    "fresnel": "dielectric",
    "diffuse_reflectance": rgb((0.1, 0.2, 0.15)),
    "specular_reflectance": 0.8,
}
LUMINANCE = (0.212671, 0.715160, 0.072169)

# The rational fit of G₁ strays by this much from Smith's function, and so may the energy
G1_FIT = 3.5e-3


def run(study: Study, *, quick: bool) -> None:
    """Hold every law in turn, in ``llvm_ad_rgb``."""
    runtime.use(runtime.FAST)
    study.text(
        "Each law is a property that the formula has and that no other renderer is needed to check: samples "
        "follow the stated density and carry value over density, light can be followed either way, no more "
        "comes out than goes in, and derivatives are those of the values."
    )
    laws = (general, furnace, dielectric_terms, published, never_negative)
    for law in study.each("laws", laws):
        law(study, quick=quick)


def load(**parameters: Any) -> Any:
    """Return an ``mrt_bsdf``."""
    return mi.load_dict({"type": "mrt_bsdf", **parameters})


def general(study: Study, *, quick: bool) -> None:
    """Check the laws of any BSDF, over forms and ways to sample; show for each what is nearest its limit."""
    for name, parameters in list(MATERIALS.items())[: 3 if quick else None]:
        found = check_bsdf({"type": "mrt_bsdf", **parameters}, quick=quick)
        for law in found.laws.values():
            if not law.skipped:
                worst = law.worst
                limit = min(worst.limit, OWN.get(law.name, worst.limit))
                least = f"{limit:.3g}" if worst.at_most else "a density 10 % too large, as the tests show"
                why = f"{worst.name}: {worst.note}; least fault: {least}"
                study.bounds.append(Bound(f"{name}: {law.name}", worst.measured, limit, worst.at_most, why))


def furnace(study: Study, *, quick: bool) -> None:
    """Hold light out to light in where Kd + Ks <= 1; record what the report's own materials reflect."""
    angles = np.array([0, 30, 60, 75, 85, 89] if quick else [*range(0, 90, 5), 87, 89])
    lines = {}
    for alpha in (0.1, 0.3, 0.7, 1.0):
        bsdf = load(alpha=alpha, fresnel="unity", diffuse_reflectance=0.0)
        lines[f"α = {alpha}"] = np.array([albedo(bsdf, at_angle(a)).max() for a in angles])
    albedos_found = [*lines.values()]
    title = "White furnace: albedo of the lobe with F = 1, Ks = 1, Kd = 0"
    note = "Light that a second bounce between facets would bring back is missing, the more the rougher."
    rows = np.column_stack([angles, *albedos_found]).tolist()
    study.table("furnace", title, ["angle of incidence, °", *lines], rows, note)
    what = "largest albedo of a lobe with F = 1, Ks = 1"
    study.at_most(what, np.max(albedos_found), 1 + G1_FIT, "the error of G₁'s rational fit")
    what = "albedo of a lobe with F = 1, Ks = 1, alpha = 0.1, head on"
    study.at_least(what, albedos_found[0][0], 1 - G1_FIT, "hardly any facet hides another")
    bsdfs = [load(alpha=m.alpha, int_ior=m.ior, **colors(m.diffuse, m.specular)) for m in SCENE_4_MATERIALS]
    most = largest(albedo(bsdf, at_angle(a)).max() for bsdf in bsdfs for a in (0, 60, 85))
    study.record("largest albedo of the report's materials, at 0 to 85 degrees", most)  # some exceed 1


def dielectric_terms(study: Study, *, quick: bool) -> None:
    """Compare ``roughdielectric``'s reflection with ours, the diffuse term with ``diffuse``."""

    def error(ours: Any, theirs: Any, wi: Any, wo: Any) -> float:
        return float(relative_error(evaluate(ours, wi, wo)[0], evaluate(theirs, wi, wo)[0]).max())

    errors = []
    for alpha, ior in product((0.02, 0.1, 0.3, 0.7, 1.0), (1.1, 1.5, 2.4)):
        ours = load(alpha=alpha, int_ior=ior, fresnel="dielectric", diffuse_reflectance=0.0)
        rough: dict[str, Any] = {"type": "roughdielectric", "distribution": "beckmann", "alpha": alpha}
        theirs = mi.load_dict({**rough, "int_ior": ior, "ext_ior": 1.0})
        errors.append(error(ours, theirs, *lobe_pairs(2_000 if quick else 20_000, alpha)))
    why = "exp of up to 16 and a few roundings"
    study.at_most("reflection against Mitsuba's, relative", largest(errors), 2.4e-5, why)
    ours = load(diffuse_reflectance=rgb(KD), specular_reflectance=0.0)
    theirs = mi.load_dict({"type": "diffuse", "reflectance": rgb(KD)})
    diffuse = error(ours, theirs, *lobe_pairs(2_000, 1.0))
    study.at_most("diffuse against Mitsuba's, relative", diffuse, 5e-7, "a few roundings")


def published(study: Study, *, quick: bool) -> None:
    """Compare five albedos published with another renderer."""
    bsdf = load(**NORI_BSDF)
    rows = [[angle, float(albedo(bsdf, at_angle(angle)) @ LUMINANCE), known] for angle, known in NORI.items()]
    title = "Albedos published for this family of BSDFs"
    study.table("published", title, ["angle °", "ours", "published"], rows)
    what = "published albedos, relative"
    why = "they were published from a Monte Carlo quadrature with about 1e-3 of noise"
    study.at_most(what, largest(abs(ours / known - 1) for _, ours, known in rows), 3e-3, why)


def never_negative(study: Study, *, quick: bool) -> None:
    """Hold that a negative roughness, as in the report's scenes, gives no negative light, whatever G₁ is."""
    least = np.inf
    for alpha in (-0.0432, -0.0099, -0.5):
        wi, wo = lobe_pairs(5_000 if quick else 100_000, abs(alpha), least_cos=0.001)
        least = min(least, evaluate(load(alpha=alpha, diffuse_reflectance=0.0), wi, wo)[0].min())
    study.at_least("least value of any lobe, negative roughness included", least, 0, "light is not negative")
