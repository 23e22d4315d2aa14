"""The laws that ``mrt_bsdf`` must obey, and known numbers."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.bsdf_probe import albedo, at_angle, rgb
from mrt_mitsuba.validation.laws.bsdf import check_bsdf
from mrt_mitsuba.validation.study import Bound, Study

TITLE = "Laws of the BSDF: sampling, energy, reciprocity, gradients, known numbers"

COLORS = {"diffuse_reflectance": rgb((0.1, 0.3, 0.5)), "specular_reflectance": rgb((0.5, 0.6, 0.2))}
EXACT = {"fresnel": "dielectric"}
CHECKER = {"type": "checkerboard", "color0": 0.1, "color1": 0.6}

# What the laws are checked on: forms and roughnesses, ways to sample, textures
MATERIALS: dict[str, dict[str, Any]] = {
    "schlick": {**COLORS},
    "dielectric, rough, plain sampling": {**COLORS, **EXACT, "alpha": 0.4, "sample_visible": False},
    "narrow": {**COLORS, **EXACT, "alpha": 0.01},
    "unity, alpha 1": {"fresnel": "unity", "diffuse_reflectance": 0.0, "alpha": 1.0},
    "textured": {"alpha": CHECKER, "diffuse_reflectance": CHECKER, "specular_reflectance": 0.3},
    "negative": {"alpha": -0.3, "specular_reflectance": rgb((0.5, 0.3, 0.2)), "diffuse_reflectance": 0.0},
    "ggx": {**COLORS, **EXACT, "distribution": "ggx", "alpha": 0.2},
    "ggx, narrow, plain sampling": {
        "distribution": "ggx",
        "alpha": 0.02,
        "diffuse_reflectance": 0.0,
        "sample_visible": False,
    },
    "with f0": {"f0": rgb((0.9, 0.5, 0.1)), "diffuse_reflectance": 0.0, "alpha": 0.2},
}

# The limits of these laws leave room for anybody's BSDF; ours is held to some roundings, eight times what was
# measured
OWN = {"gradients": 1e-5, "weights": 2e-6, "variants": 2e-6}
OWN |= dict.fromkeys(("reciprocity", "eval_pdf", "components", "switch"), 1e-6)

# Albedos by angle that the tests of Nori give for a BSDF of this family, and its parameters
NORI = {0: 0.207067, 45: 0.215733, 60: 0.247884, 80: 0.430936, 85: 0.519016}
NORI_BSDF = {**EXACT, "alpha": 0.1, "int_ior": 1.5, "ext_ior": 1.000277, "specular_reflectance": 0.8}
NORI_BSDF |= {"diffuse_reflectance": rgb((0.1, 0.2, 0.15))}
LUMINANCE = (0.212671, 0.715160, 0.072169)


def run(study: Study, *, quick: bool) -> None:
    """Hold the laws and the numbers, in ``llvm_ad_rgb``."""
    runtime.use(runtime.FAST)
    study.texts.append(
        "Each law is a property that the formula has and that no other renderer is needed to check: samples "
        "follow the stated density and carry value over density, light can be followed either way, no more "
        "comes out than goes in, and derivatives are those of the values."
    )
    for name in study.each("laws", list(MATERIALS)[: 3 if quick else None]):
        found = check_bsdf({"type": "mrt_bsdf", **MATERIALS[name]}, quick=quick)
        for law in (law for law in found.laws.values() if not law.skipped):
            worst = law.worst
            limit = min(worst.limit, OWN.get(law.name, worst.limit))
            least = f"{limit:.3g}" if worst.at_most else "a density 10 % too large, as the tests show"
            why = f"{worst.name}: {worst.note}; least fault: {least}"
            study.bounds.append(Bound(f"{name}: {law.name}", worst.measured, limit, worst.at_most, why))
    known(study, quick=quick)


def known(study: Study, *, quick: bool) -> None:
    """Compare albedos with those published with another renderer."""
    bsdf = mi.load_dict({"type": "mrt_bsdf", **NORI_BSDF})
    rows = []
    for angle, published in NORI.items():
        ours = float(albedo(bsdf, at_angle(angle)) @ LUMINANCE)
        rows.append({"angle °": angle, "ours": ours, "published": published})
    study.records("published", "Albedos published for this family", rows)
    off = np.max([abs(row["ours"] / row["published"] - 1) for row in rows])
    why = "they were published from a Monte Carlo quadrature with about 1e-3 of noise"
    study.at_most("published albedos, relative", off, 3e-3, why)
