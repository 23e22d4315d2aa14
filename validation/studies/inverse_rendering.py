"""An example of inverse rendering: roughness and diffuse colour of a ball, recovered from one picture."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.optimize import minimize

from mrt_mitsuba.validation.tools.bsdf_probe import rgb
from mrt_mitsuba.validation.tools.gallery import panels
from mrt_mitsuba.validation.tools.scenery import camera
from mrt_mitsuba.validation.tools.study import Study

ALPHA, KD = 0.25, (0.6, 0.35, 0.15)  # to be found
START_ALPHA, START_KD = 0.6, (0.4, 0.4, 0.4)
SIZE = 48  # pixels
NAMES = ("ball.bsdf.alpha", "ball.bsdf.diffuse_reflectance.value")


def run(study: Study, *, quick: bool) -> None:
    """Start from a wrong guess, follow the gradient of the squared difference, and compare with the truth."""
    target = np.array(mi.render(_scene(ALPHA, KD), spp=256, seed=1000))
    scene = _scene(START_ALPHA, START_KD)
    first = np.array(mi.render(scene, spp=64, seed=2000))
    path = _descend(scene, mi.TensorXf(target), spp=16 if quick else 64)
    last = np.array(mi.render(scene, spp=64, seed=2000))
    study.picture(
        "inverse",
        "Inverse rendering: given picture, first guess, result",
        np.concatenate([target, first, last], axis=1),
        f"Roughness and diffuse colour follow the gradient of the picture, {len(path) - 1} renders long.",
    )
    caption = "Dashed: the values with which the given picture was rendered."
    study.plot("inverse-path", "Inverse rendering: the parameters by render", _figure(path), caption)
    alpha, kd = path[-1, 0], path[-1, 1:]
    why = "the two pictures sample their pixels at different points"
    study.at_most("roughness recovered from a picture, error", abs(alpha - ALPHA), 1e-4, why)
    study.at_most("diffuse colour recovered from a picture, error", np.abs(kd - KD).max(), 2e-4, why)


def _scene(alpha: float, kd: tuple[float, float, float]) -> Any:
    sampler = {"sampler": {"type": "stratified"}}
    paint = {"diffuse_reflectance": rgb(kd), "specular_reflectance": 0.8, "fresnel": "dielectric"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
            "sensor": camera([0, -4, 0], [0, 0, 0], [0, 0, 1], SIZE, SIZE, fov=32, **sampler),
            "lamp": {"type": "point", "position": [-2, -4, 2], "intensity": 60.0},
            "ball": {"type": "sphere", "bsdf": {"type": "mrt_bsdf", "alpha": alpha, **paint}},
        }
    )


def _descend(scene: Any, target: Any, *, spp: int) -> np.ndarray:
    """Return alpha and Kd at each evaluation of L-BFGS-B, [evaluations, 4]; the scene keeps the last ones.

    Every picture has the same seed, and one light leaves no noise but that of the points in a pixel: the
    difference is a smooth function of the parameters.
    """
    parameters = mi.traverse(scene)
    path = []

    def difference(values: np.ndarray) -> tuple[float, np.ndarray]:
        path.append(values.copy())
        alpha, kd = mi.Float(float(values[0])), mi.Color3f(values[1:].tolist())
        dr.enable_grad(alpha, kd)
        parameters[NAMES[0]], parameters[NAMES[1]] = alpha, kd
        parameters.update()
        picture = mi.render(scene, parameters, spp=spp)
        # a thousand: far from the sizes at which the optimiser takes a step for the last one
        loss = 1000 * dr.mean(dr.square(picture - target), axis=None)
        dr.backward(loss)
        return float(loss.array[0]), np.array([*dr.grad(alpha), *np.ravel(dr.grad(kd))], np.float64)

    start = np.array([START_ALPHA, *START_KD])
    found = minimize(difference, start, jac=True, method="L-BFGS-B", bounds=[(0.02, 1)] + [(0, 1)] * 3)
    parameters[NAMES[0]], parameters[NAMES[1]] = mi.Float(float(found.x[0])), mi.Color3f(found.x[1:].tolist())
    parameters.update()
    return np.array([*path, found.x])


def _figure(path: np.ndarray) -> Any:
    figure, axes = panels(6, 4)
    labels, colors = ("α", "Kd red", "Kd green", "Kd blue"), ("black", "tab:red", "tab:green", "tab:blue")
    for values, true, label, color in zip(path.T, (ALPHA, *KD), labels, colors, strict=True):
        axes.plot(values, color=color, label=label)
        axes.axhline(true, color=color, linestyle="--", linewidth=0.8)
    axes.set(xlabel="render", ylabel="value", ylim=(0, 1))
    axes.legend()
    return figure
