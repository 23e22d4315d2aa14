"""``mrt_adaptive``: what ``mrt.render`` does with a ``target``, as an integrator of Mitsuba."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.adaptive.metric import LINEAR, METRICS
from mrt_mitsuba.adaptive.target import AdaptiveIntegrator, Goal, Target
from mrt_mitsuba.errors import warn
from mrt_mitsuba.plugins.parameters import ParameterError, flag, integer, number
from mrt_mitsuba.plugins.variants import construct_quietly, text_of
from mrt_mitsuba.rendering.settings import MAX_SPP

PARAMETERS = ("target", "metric", "denoise", "max_spp", "max_seconds", "spp")
MIN_SPP = 8  # rays of a pixel in the first round


@AdaptiveIntegrator.register
class MrtAdaptive(mi.SamplingIntegrator):
    r"""Adaptive sampling of a nested integrator, in rounds, until an error target is met.

    It does what ``mrt.render`` does with ``target``, where there is only ``mi.render`` or an XML file. The
    scene's film is filled by its own rules, and holds the channels of the nested integrator, then
    ``error.Y``, the standard error of each pixel, and ``samples.Y``, its rays, unless that has such names
    itself; a ``specfilm`` holds its bands only. Derivatives are those of the nested integrator, at the
    ``spp`` that ``mi.render`` is given.

    ================ =========== ======== ================================================================
    name             type        default  unit or range
    ================ =========== ======== ================================================================
    ``target``       float or    0.01     > 0, RMSE to the converged picture; "2%": of its mean luminance or,
                     string               with another metric, of 1
    ``metric``       string      linear   "linear", "relative" or "display": RMSE of linear values, relative
                                          to them, or of sRGB values clipped to [0, 1]
    ``denoise``      boolean     false    mix the picture with its denoised version where that errs less
    ``max_spp``      integer     4096     >= 8, rays of a pixel at most, on average
    ``max_seconds``  float       0        >= 0, time to spend at most; 0 for no limit
    ``spp``          integer     (none)   >= 8, in place of ``target``: average samples per pixel
    (any name)       integrator           required: the nested integrator, any but ``mrt_adaptive``
    ================ =========== ======== ================================================================

    .. code-block:: python

        {'type': 'mrt_adaptive', 'target': 0.01, 'nested': {'type': 'path'}}

    .. code-block:: xml

        <integrator type="mrt_adaptive">
            <float name="target" value="0.01"/>
            <integrator type="path"/>
        </integrator>

    Nearest stock plugin: none; ``moment`` shows the noise, and does nothing about it. An ``spp`` given to
    ``mi.render`` bounds the mean rays of a pixel, from 8 on; that of the scene's sampler does not count.
    """

    def __init__(self, props: mi.Properties) -> None:
        construct_quietly(self, props)
        given = {name: props[name] for name in props if name not in PARAMETERS}
        inner = [thing for thing in given.values() if isinstance(thing, mi.Integrator)]
        others = [name for name, thing in given.items() if not isinstance(thing, mi.Integrator)]
        if others:
            known = ", ".join(PARAMETERS)
            raise ParameterError(f'mrt_adaptive: "{others[0]}" is not a parameter; known: {known}')
        if len(inner) != 1 or isinstance(inner[0], MrtAdaptive):
            raise ParameterError("mrt_adaptive: give one integrator inside, such as path")
        if not isinstance(inner[0], mi.SamplingIntegrator):
            raise ParameterError(
                f"mrt_adaptive: {inner[0].class_name()} gives whole pictures, not single rays; nest another, "
                "such as path"
            )
        self.nested = inner[0]
        self.goal = _goal(props)

    def bounded(self, spp: int) -> Goal:
        """Return the goal with an average of ``spp`` samples per pixel at most, as ``mi.render`` gives it.

        0: no bound.
        """
        if not spp:
            return self.goal
        most = spp if self.goal.target is None else min(self.goal.max_spp, spp)
        return replace(self.goal, max_spp=max(most, MIN_SPP))

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        from mrt_mitsuba.rendering.api import render_source, session
        from mrt_mitsuba.rendering.progress import Progress
        from mrt_mitsuba.rendering.settings import RenderSettings
        from mrt_mitsuba.scene.open import opened

        if 0 < spp < MIN_SPP:
            warn(f"mrt_adaptive takes {MIN_SPP} spp at least, not spp={spp}")
        number = sensor if isinstance(sensor, int) else 0
        view = _sensor(scene, sensor)
        seed = int(np.ravel(seed)[0]) % 2**32
        settings = RenderSettings(seed=seed, sensor=number, progress=Progress())
        with dr.suspend_grad(), session(settings) as job:
            source = replace(opened("a Mitsuba scene", scene, view, self.nested), goal=self.bounded(spp))
            result = render_source(source, settings, job)
            film = view.film()
            layers = result.layers
            names = [] if _has_bands_only(film) else self.aov_names()
            colors = [layers[name] for name in result.plan.bands] or list(np.moveaxis(result.image, -1, 0))
            alpha = [layers["A"]] if "A" in layers else []
            planes = [*colors, *alpha, np.ones_like(result.image[..., 0]), *(layers[name] for name in names)]
            film.prepare(names)
            values = mi.TensorXf(np.ascontiguousarray(np.stack(planes, -1), np.float32))
            film.put_block(
                mi.ImageBlock(tensor=values, offset=film.crop_offset(), rfilter=film.rfilter(), border=False)
            )
            return self._seen(film.develop(), names) if develop else mi.TensorXf()

    def sample(self, *_: Any) -> Any:
        raise ParameterError(
            "mrt_adaptive: it is no part of another integrator; put aov or moment into it instead"
        )

    def aov_names(self) -> list[str]:
        theirs = self.nested.aov_names()
        return [*theirs, *(name for name in ("error.Y", "samples.Y") if name not in theirs)]

    def _further(self, scene: mi.Scene, sensor: mi.Sensor | int) -> int:
        """Number of channels of the film next to those of the nested integrator."""
        if _has_bands_only(_sensor(scene, sensor).film()):
            return 0
        return len(self.aov_names()) - len(self.nested.aov_names())

    def _seen(self, picture: mi.TensorXf, names: list[str]) -> mi.TensorXf:
        """Picture as ``mi.render`` returns it, whose last channels have these ``names``.

        Of an ``aov``, it shows each integrator inside like a film; the first as the colours.
        """
        if self.nested.class_name() != "AOVIntegrator" or not names:
            return picture
        from mrt_mitsuba.adaptive.estimate import LUMINANCE

        film, further = np.split(np.array(picture), [picture.shape[2] - len(names)], axis=2)
        shown = list[np.ndarray]()
        while [name[-1] for name in names[:4]] == ["R", "G", "B", "A"]:
            colors, alpha, further = np.split(further, [3, 4], axis=2)
            grey = (colors @ LUMINANCE)[..., None]
            transparent = film.shape[2] in (2, 4)
            inside = [grey if film.shape[2] < 3 else colors, *[alpha] * transparent]
            shown += inside if shown else [film]
            names = names[4:]
        return mi.TensorXf(np.concatenate([*shown, further], axis=2, dtype=np.float32))

    def render_forward(
        self, scene: mi.Scene, params: Any, sensor: mi.Sensor | int = 0, seed: int = 0, spp: int = 0
    ) -> mi.TensorXf:
        found = self.nested.render_forward(scene, params, sensor, seed, spp)
        nothing = dr.zeros(mi.TensorXf, (*found.shape[:2], self._further(scene, sensor)))
        return dr.concat([found, nothing], axis=2)

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: mi.TensorXf,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
    ) -> None:
        kept = grad_in.shape[2] - self._further(scene, sensor)
        self.nested.render_backward(scene, params, grad_in[..., :kept], sensor, seed, spp)

    def traverse(self, callback: Any) -> None:
        callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

    def to_string(self) -> str:
        goal = self.goal
        aim = (
            f"spp={goal.max_spp}" if goal.target is None else f"target={goal.target}, max_spp={goal.max_spp}"
        )
        return f"MrtAdaptive[{aim}, max_seconds={goal.max_seconds or 0:g}, nested={text_of(self.nested)}]"


def _goal(props: mi.Properties) -> Goal:
    """The goal that the parameters state; raise ``ParameterError`` for values that are not allowed."""
    if "spp" in props and "target" in props:
        raise ParameterError('mrt_adaptive: give "target" or "spp", not both')
    metric = props.get("metric", LINEAR.name)
    if metric not in METRICS:
        raise ParameterError(f'mrt_adaptive: "metric" is {metric!r}, but must be one of {", ".join(METRICS)}')
    denoise = flag(props, "denoise", False)
    seconds = number(props, "max_seconds", 0.0, least=0) or None
    most = integer(props, "max_spp", MAX_SPP, least=MIN_SPP, most=2**24)
    if "spp" in props:
        return Goal(None, integer(props, "spp", most, least=MIN_SPP, most=65536), seconds, metric, denoise)
    return Goal(_target(props), most, seconds, metric, denoise)


def _target(props: mi.Properties) -> Target:
    value = props.get("target", 0.01)
    with suppress(TypeError, ValueError):
        return Target.of(value)
    raise ParameterError(
        f'mrt_adaptive: "target" is {value!r}, but must be a number > 0, or a percentage such as "2%"'
    )


def _sensor(scene: mi.Scene, sensor: mi.Sensor | int) -> mi.Sensor:
    return scene.sensors()[sensor] if isinstance(sensor, int) else sensor


def _has_bands_only(film: mi.Film) -> bool:
    return mi.has_flag(film.flags(), mi.FilmFlags.Special)  # specfilm
