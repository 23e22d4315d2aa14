"""The laws that ``mrt_bsdf`` must obey by itself: sampling, energy, reciprocity, gradients, known numbers."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.studies import inverse_rendering
from mrt_mitsuba.validation.tools.bsdf_probe import (
    albedo,
    at_angle,
    draw,
    evaluate,
    evaluate_from,
    interaction,
    largest,
    lobe_pairs,
    relative_error,
    rgb,
)
from mrt_mitsuba.validation.tools.image_tests import sidak
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Laws of the BSDF: sampling, energy, reciprocity, gradients, known numbers"

FORMS = ("schlick", "dielectric", "unity")
KD, KS = (0.1, 0.3, 0.5), (0.9, 0.6, 0.2)

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
    """Every law in turn, in ``llvm_ad_rgb``."""
    runtime.use(runtime.FAST)
    study.text(
        "Each law is a property that the formula has and that no other renderer is needed to check: samples "
        "follow the stated density and carry value over density, light can be followed either way, no more "
        "comes out than goes in, and derivatives are those of the values."
    )
    laws = (
        chi_square,
        weights,
        reciprocity,
        albedos,
        furnace,
        dielectric_terms,
        published,
        never_negative,
        gradients,
        inverse_rendering.run,
    )
    with study.stage("laws", len(laws)) as advance:
        for law in laws:
            law(study, quick=quick)
            advance(1)


def load(**parameters: Any) -> Any:
    """An ``mrt_bsdf``."""
    import mitsuba as mi

    return mi.load_dict({"type": "mrt_bsdf", **parameters})


def colored(**parameters: Any) -> Any:
    """An ``mrt_bsdf`` whose lobes have colours."""
    return load(**{"diffuse_reflectance": rgb(KD), "specular_reflectance": rgb(KS), **parameters})


def chi_square(study: Study, *, quick: bool) -> None:
    """``sample`` against ``pdf`` by Mitsuba's own test, over roughness, angle, Fresnel form and sampling."""
    alphas, angles = ((0.1, 0.5), (0, 75)) if quick else ((0.05, 0.1, 0.3, 0.6, 1.0), (0, 30, 60, 80))
    forms = ("dielectric", "unity") if quick else FORMS
    rows: list[list[Any]] = []
    with _scratch_folder():
        for alpha, degrees, form, visible in product(alphas, angles, forms, (True, False)):
            parameters = {"type": "mrt_bsdf", "alpha": alpha, "fresnel": form, "sample_visible": visible}
            rows.append([alpha, degrees, form, visible, _chi_square(parameters, degrees)])
    study.table(
        "chi-square", "Chi-square tests of sampling", ["alpha", "angle °", "Fresnel", "visible", "p"], rows
    )
    study.at_least(
        f"smallest p of {len(rows)} chi-square tests, for their number",
        sidak(min(row[-1] for row in rows), len(rows)),
        0.001,
        "one false alarm in a thousand seeds, and the seeds are fixed",
    )


def _chi_square(parameters: dict[str, Any], degrees: float) -> float:
    """The p value; 0 where the test cannot even be made, such as for samples where the density is 0."""
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    sample, pdf = BSDFAdapter(
        "mrt_bsdf", parameters | {"diffuse_reflectance": 0.05}, wi=at_angle(degrees).tolist()
    )
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=200_000, res=101, ires=32)
    return float(np.ravel(test.p_value)[0]) if test.run(0.0, quiet=True) and not test.fail else 0.0


@contextlib.contextmanager
def _scratch_folder() -> Iterator[None]:
    """Work in a folder that goes away: Mitsuba's test writes its tables where it runs if it fails."""
    before = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)


def weights(study: Study, *, quick: bool) -> None:
    """A sample's density and weight against ``eval`` and ``pdf`` there; ``eval_pdf`` against both."""
    import drjit as dr
    import mitsuba as mi

    count, wi = (5_000 if quick else 50_000), at_angle(50)
    density, weight, apart = [], [], []
    for form, visible, alpha in product(FORMS, (True, False), (0.02, 0.1, 0.5)):
        bsdf = colored(alpha=alpha, fresnel=form, sample_visible=visible)
        samples, found = draw(bsdf, wi, count)
        wo, pdf = np.array(samples.wo).T, np.array(samples.pdf)
        up = pdf > 0
        value, expected = evaluate_from(bsdf, wi, wo)
        density.append(alpha * np.abs(pdf[up] / expected[up] - 1).max())
        ratio = value[up] / expected[up][:, None]
        weight.append(alpha * np.abs(found[up] / ratio - 1).max())
        ctx, si, direction = mi.BSDFContext(), interaction(wi), mi.Vector3f(wo.T)
        pair = bsdf.eval_pdf(ctx, si, direction)
        apart += [
            float(dr.max(dr.abs(pair[0] - bsdf.eval(ctx, si, direction)), axis=None)[0]),
            float(dr.max(dr.abs(pair[1] - bsdf.pdf(ctx, si, direction)))[0]),
        ]
    why = "evaluated again, half vectors come from rounded directions: 1e-7 over alpha, times the slope"
    study.at_most("density of samples against pdf, relative, times alpha", largest(density), 2e-6, why)
    study.at_most("weight of samples against eval / pdf, relative, times alpha", largest(weight), 2e-6, why)
    study.at_most(
        "eval_pdf against eval and pdf", largest(float(x) for x in apart), 0, "the same computation"
    )


def reciprocity(study: Study, *, quick: bool) -> None:
    """f(ωi, ωo) = f(ωo, ωi)."""
    errors = []
    for form, alpha in product(FORMS, (0.01, 0.1, 0.4, 1.0)):
        wi, wo = lobe_pairs(5_000 if quick else 100_000, alpha)
        bsdf = colored(alpha=alpha, fresnel=form)
        one, other = evaluate(bsdf, wi, wo)[0] / wo[:, 2:], evaluate(bsdf, wo, wi)[0] / wi[:, 2:]
        errors.append(np.abs(one / other - 1).max())
    study.at_most(
        "reciprocity, relative",
        largest(errors),
        1e-6,
        "every step but the last product is symmetric in float32",
    )


def albedos(study: Study, *, quick: bool) -> None:
    """The mean weight of samples against the integral of the values, which ``sample`` has no part in."""
    count = 200_000 if quick else 1_000_000
    rows: list[list[Any]] = []
    for form, visible, degrees in product(FORMS, (True, False), (10, 75)):
        bsdf, wi = colored(alpha=0.3, fresnel=form, sample_visible=visible), at_angle(degrees)
        weight = draw(bsdf, wi, count)[1]
        error, expected = weight.std(axis=0) / np.sqrt(count), albedo(bsdf, wi)
        z = (weight.mean(axis=0) - expected) / (error + 2e-5)
        rows.append(
            [form, visible, degrees, expected.mean(), weight.mean(), float(np.abs(z).max()), error.max()]
        )
    columns = ["Fresnel", "visible", "angle °", "by quadrature", "mean weight", "largest z", "standard error"]
    study.table("albedos", "Albedo: quadrature and mean weight of samples", columns, rows)
    study.at_most(
        "albedo by quadrature against mean weight, standard errors",
        largest(row[5] for row in rows),
        5,
        "36 comparisons; 2e-5 is allowed for the grid of the quadrature",
    )
    study.at_most(
        "standard error of the mean weight",
        largest(row[6] for row in rows),
        3e-3,
        "five of them still see 2 % of the brightest channel",
    )


def furnace(study: Study, *, quick: bool) -> None:
    """No more light out than in where Kd + Ks <= 1; what the report's own materials reflect is recorded."""
    from matplotlib.figure import Figure

    angles = np.array([0, 30, 60, 75, 85, 89] if quick else [*range(0, 90, 5), 87, 89])
    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    albedos_found = []
    for alpha in (0.1, 0.3, 0.7, 1.0):
        bsdf = load(alpha=alpha, fresnel="unity", diffuse_reflectance=0.0)
        found = np.array([albedo(bsdf, at_angle(a)).max() for a in angles])
        albedos_found.append(found)
        axes.plot(angles, found, marker=".", label=f"α = {alpha}")
    axes.axhline(1, color="black", linewidth=0.8)
    axes.set(xlabel="angle of incidence [°]", ylabel="albedo", ylim=(0, 1.05))
    axes.legend()
    study.plot(
        "furnace",
        "White furnace: albedo of the lobe with F = 1, Ks = 1, Kd = 0",
        figure,
        "Light that a second bounce between facets would bring back is missing, the more the rougher.",
    )
    study.at_most(
        "largest albedo of a lobe with F = 1, Ks = 1",
        np.max(albedos_found),
        1 + G1_FIT,
        "the error of G₁'s rational fit",
    )
    study.at_least(
        "albedo of a lobe with F = 1, Ks = 1, alpha = 0.1, head on",
        albedos_found[0][0],
        1 - G1_FIT,
        "hardly any facet hides another",
    )
    study.record("largest albedo of the report's materials, at 0 to 85 degrees", _report_albedo())


def _report_albedo() -> float:
    """Their Kd and Ks promise nothing: some add up to more than 1."""
    from mrt_mitsuba.scene.report import SCENE_4_MATERIALS

    bsdfs = [
        load(
            alpha=m.alpha,
            int_ior=m.ior,
            diffuse_reflectance=rgb(m.diffuse),
            specular_reflectance=rgb(m.specular),
        )
        for m in SCENE_4_MATERIALS
    ]
    return largest(albedo(bsdf, at_angle(a)).max() for bsdf in bsdfs for a in (0, 60, 85))


def dielectric_terms(study: Study, *, quick: bool) -> None:
    """``roughdielectric``'s reflection and its factors against ours; the diffuse term against ``diffuse``."""
    import mitsuba as mi

    errors: dict[str, float] = dict.fromkeys(("D", "G", "F", "reflection", "diffuse"), 0.0)
    for alpha, ior in product((0.02, 0.1, 0.3, 0.7, 1.0), (1.1, 1.5, 2.4)):
        wi, wo = lobe_pairs(2_000 if quick else 20_000, alpha)
        ours = load(alpha=alpha, int_ior=ior, fresnel="dielectric", diffuse_reflectance=0.0)
        theirs = mi.load_dict(
            {
                "type": "roughdielectric",
                "distribution": "beckmann",
                "alpha": alpha,
                "int_ior": ior,
                "ext_ior": 1.0,
            }
        )
        value = evaluate(ours, wi, wo)[0]
        found = {
            "reflection": relative_error(value, evaluate(theirs, wi, wo)[0]).max(),
            **_factors(alpha, ior, wi, wo),
        }
        errors |= {name: largest((errors[name], error)) for name, error in found.items()}
    wi, wo = lobe_pairs(2_000, 1.0)
    diffuse: list[dict[str, Any]] = [
        {"type": "mrt_bsdf", "diffuse_reflectance": rgb(KD), "specular_reflectance": 0.0},
        {"type": "diffuse", "reflectance": rgb(KD)},
    ]
    one, other = (evaluate(mi.load_dict(d), wi, wo)[0] for d in diffuse)
    errors["diffuse"] = relative_error(one, other).max()
    for name, error in errors.items():
        study.at_most(
            f"{name} against Mitsuba's, relative",
            error,
            2.4e-5,
            "exp of up to 16 and a few roundings" if name in ("D", "reflection") else "a few roundings",
        )


def _factors(alpha: float, ior: float, wi: Any, wo: Any) -> dict[str, float]:
    """Ratios of values that differ in one factor only, so that each is seen through the BSDF."""
    import mitsuba as mi

    i, o = mi.Vector3f(wi.T), mi.Vector3f(wo.T)
    h = mi.Vector3f(
        ((wi.astype(float) + wo) / np.linalg.norm(wi.astype(float) + wo, axis=-1, keepdims=True)).T
    )
    theirs = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, alpha)
    plain, dielectric = (
        load(alpha=alpha, int_ior=ior, fresnel=form, diffuse_reflectance=0.0, sample_visible=False)
        for form in ("unity", "dielectric")
    )
    (lobe, pdf), (with_fresnel, _) = evaluate(plain, wi, wo), evaluate(dielectric, wi, wo)
    dot = 0.5 * np.linalg.norm(wi.astype(float) + wo, axis=-1)
    d = pdf * 4 * dot / np.array(h.z)  # the density of plain sampling is D cos θh / (4 ωo·h)
    g = lobe[:, 0] * 4 * wi[:, 2] / d
    f = with_fresnel[:, 0] / lobe[:, 0]
    seen = lobe[:, 0] > 1e-7 * lobe.max()
    expected = {
        "D": np.array(theirs.eval(h)),
        "G": np.array(theirs.G(i, o, h)),
        "F": np.array(mi.fresnel(mi.Float(dot), ior)[0]),
    }
    found = {"D": d, "G": g, "F": f}
    return {name: largest(np.abs(found[name] / expected[name] - 1)[seen]) for name in expected}


def published(study: Study, *, quick: bool) -> None:
    """Five albedos published with another renderer."""
    bsdf = load(**NORI_BSDF)
    rows = [[angle, float(albedo(bsdf, at_angle(angle)) @ LUMINANCE), known] for angle, known in NORI.items()]
    study.table(
        "published", "Albedos published for this family of BSDFs", ["angle °", "ours", "published"], rows
    )
    study.at_most(
        "published albedos, relative",
        largest(abs(ours / known - 1) for _, ours, known in rows),
        3e-3,
        "they were published from a Monte Carlo quadrature with about 1e-3 of noise",
    )


def never_negative(study: Study, *, quick: bool) -> None:
    """Of a negative roughness, which the report's scenes hold, G₁ may be negative; the light may not."""
    least = np.inf
    for alpha in (-0.0432, -0.0099, -0.5):
        wi, wo = lobe_pairs(5_000 if quick else 100_000, abs(alpha), least_cos=0.001)
        least = min(least, evaluate(load(alpha=alpha, diffuse_reflectance=0.0), wi, wo)[0].min())
    study.at_least("least value of any lobe, negative roughness included", least, 0, "light is not negative")


def gradients(study: Study, *, quick: bool) -> None:
    """Derivatives of the mean value over directions, forward and reverse, against central differences."""
    import mitsuba as mi

    start = {
        "alpha": 0.3,
        "int_ior": 1.5,
        "diffuse_reflectance.value": 0.4,
        "specular_reflectance.value": 0.9,
    }
    pairs = lobe_pairs(1_000, 0.3)
    rows: list[list[Any]] = []
    for form, (name, value) in product(("schlick", "dielectric"), start.items()):
        bsdf = load(fresnel=form, **{key.removesuffix(".value"): number for key, number in start.items()})
        parameters = mi.traverse(bsdf)
        step = 0.01 * value
        slope = (
            _mean(bsdf, parameters, name, mi.Float(value + step), pairs)[0]
            - _mean(bsdf, parameters, name, mi.Float(value - step), pairs)[0]
        ) / (2 * step)
        found = np.array(
            [_gradient(bsdf, parameters, name, value, pairs, forward) for forward in (True, False)]
        )
        rows.append([form, name.removesuffix(".value"), slope, *found, largest(np.abs(found / slope - 1))])
    columns = ["Fresnel", "parameter", "differences", "forward", "reverse", "relative error"]
    study.table("gradients", "Derivatives of the mean value", columns, rows)
    study.at_most(
        "gradients against central differences, relative",
        largest(row[-1] for row in rows),
        2e-3,
        "differences of 1 %: its square times a third derivative, and 1e-7 of the mean over the step",
    )


def _mean(bsdf: Any, parameters: Any, name: str, value: Any, pairs: tuple[Any, Any]) -> Any:
    import drjit as dr
    import mitsuba as mi

    parameters[name] = value
    parameters.update()
    return dr.mean(bsdf.eval(mi.BSDFContext(), interaction(pairs[0]), mi.Vector3f(pairs[1].T)), axis=None)


def _gradient(
    bsdf: Any, parameters: Any, name: str, value: float, pairs: tuple[Any, Any], forward: bool
) -> float:
    import drjit as dr
    import mitsuba as mi

    variable = mi.Float(value)
    dr.enable_grad(variable)
    result = _mean(bsdf, parameters, name, variable, pairs)
    if forward:
        dr.forward(variable)
        return float(dr.grad(result)[0])
    dr.backward(result)
    return float(dr.grad(variable)[0])
