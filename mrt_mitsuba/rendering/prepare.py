"""Rendering one scene again and again by kernels that Dr.Jit recorded once (``dr.freeze``)."""

from __future__ import annotations

import weakref
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.interrupts import defer_signals
from mrt_mitsuba.plugins.whitted.snapshot import SnapshotPart
from mrt_mitsuba.rendering.api import Result, open_with, refuse_freezing, render_source, session
from mrt_mitsuba.rendering.exposing import Exposer
from mrt_mitsuba.rendering.film import Film
from mrt_mitsuba.rendering.settings import RenderOptions, RenderSettings
from mrt_mitsuba.rendering.shading import Shader, camera_matrices
from mrt_mitsuba.scene.open import opened

if TYPE_CHECKING:
    from typing_extensions import Unpack


class Prepared:
    """A scene ready to be rendered: ``again(seed=…)`` equals ``mrt.render`` to the bit.

    ``params``: its parameters by keys of ``mi.traverse``. Changes of these take effect in the next
    render, the film's size included; a change of the kernel plan, such as a first mirror, recompiles.
    """

    _source: Any = None  # the open scene
    _state: SnapshotPart | None = None  # of camera and integrator, for which the kernels were recorded
    _exposer: Any = None  # whose kernels are recorded
    _launch: Any = None  # what launches them; None where nothing is recorded

    def __init__(self, scene: object, settings: RenderSettings) -> None:
        self._scene = scene
        self._settings = settings
        with runtime.render_lock, defer_signals():
            self._render(self._settings.seed)
            self._film_window = _window(self._source.sensor.film())
            self.params = mi.traverse(self._source.scene)
            self._record()

    def __call__(self, seed: int = 0) -> Result:
        """Render the scene as it is now; ``seed`` is of all random numbers."""
        refuse_freezing()
        with runtime.render_lock, defer_signals(), runtime.within(self._made.plan.variant):
            self.params.update()
            self._resize()
            if self._launch is None:
                return self._render(seed)
            self._exposer.shader = shader = Shader(self._view, None)
            plan = replace(self._made.plan, facts=shader.facts)
            if shader.kernel != plan.kernel or self._look() is not self._state:
                self._render(seed)
                self._record()
                return self._made
            options = {**self._made.options, "seed": seed}
            return replace(self._made, image=self._picture(seed), plan=plan, options=options)

    def _resize(self) -> None:
        """Take up a new size of the film; raise ``UsageError`` where the options state another."""
        window = _window(self._source.sensor.film())
        if window == self._film_window:
            return
        if self._settings.width or self._settings.height:
            raise UsageError(
                "the film has another size or crop window than before, but width or height was given to "
                "prepare: leave them out there, or call prepare with others"
            )
        source = self._source
        now = opened(source.name, source.scene, source.sensor, source.integrator)
        self._source = replace(source, width=now.width, height=now.height)
        self._film_window = window

    def _render(self, seed: int) -> Result:
        """Render from scratch; later results differ from this one by the picture."""
        settings = replace(self._settings, seed=seed)
        with session(settings) as job:
            self._source = self._source or open_with(self._scene, settings)
            self._made = render_source(self._source, settings, job)
            self._job = job
        return self._made

    def _look(self) -> SnapshotPart:
        """The state of the camera and the integrator, the same object if it is the same."""
        now = SnapshotPart()
        settings = vars(self._source.integrator)
        now.add(self._source.sensor, ())
        now.state += [settings[name] for name in sorted(settings) if not name.startswith("_")]
        return now.close(self._state)

    def _record(self) -> None:
        """Record the kernels, if they read only what is known and give the picture that they should."""
        self._launch = None
        made = self._made
        plan = made.plan
        first = plan.passes[0]
        size = (plan.width, plan.height)
        sensor = self._source.sensor
        film = Film(sensor)
        window = _window(sensor.film())
        plain = (
            (sensor.class_name(), film.sampler) == ("PerspectiveCamera", "IndependentSampler")
            and (film.rfilter.class_name(), film.pixel_format) == ("BoxFilter", "rgb")
            and sensor.shutter_open_time() == 0
            and (window[2:4] != size or window[:2] == size)  # else only a part of its film is seen
        )
        alone = len(plan.passes) == 1 and first.layers == {"image"} and first.pattern.size == 1
        traced = plan.kernel is not None and plan.variant == "llvm_ad_rgb"
        if not (plain and alone and traced) or plan.layers or plan.time_strata:
            return
        # A camera of its own, of the size of the picture
        clip = {"near_clip": sensor.near_clip(), "far_clip": sensor.far_clip()}
        own_film = {"type": "hdrfilm", "width": size[0], "height": size[1], "filter": {"type": "box"}}
        view = mi.load_dict({"type": "perspective", **clip, "film": own_film})
        own = mi.traverse(view)
        theirs = mi.traverse(sensor)
        names = "x_fov", "principal_point_offset_x", "principal_point_offset_y", "to_world"
        own.update({name: theirs[name] for name in names})
        self._view = replace(self._source, sensor=view)
        shader = Shader(self._view, None)
        if shader.read() is None:
            return
        self._state = None
        self._state = self._look()
        self._exposer = Exposer(self._job, shader, first)
        self._made = replace(made, camera=camera_matrices(view))
        # By a weak reference: in a ring, garbage collection would free recordings in the midst of another one
        me: Any = weakref.ref(self)
        self._launch = dr.freeze(lambda seed, read: me()._trace(seed))
        try:
            same = all(np.array_equal(self._picture(made.options["seed"]), made.image) for _ in range(2))
        except RuntimeError:  # something else is read
            same = False
        self._launch = self._launch if same else None

    def _picture(self, seed: int) -> np.ndarray:
        """The picture that the recorded kernels give."""
        channels = self._launch(mi.UInt32(seed), self._exposer.shader.read())
        return np.stack([np.asarray(c) for c in channels], axis=-1).reshape(self._made.image.shape)

    def _trace(self, seed: Any) -> list[Any]:
        """The channels along one ray of each pixel."""
        exposer = self._exposer
        plan = self._made.plan
        samples = exposer.samples(plan.passes[0].pattern, seed)
        pixel = dr.arange(mi.UInt32, plan.width * plan.height)
        return exposer.trace(pixel, mi.UInt32(0), samples)[1]


def _window(film: mi.Film) -> tuple[int, ...]:
    """Size, size of the crop window and its offset, in pixels."""
    return tuple(int(n) for n in (*film.size(), *film.crop_size(), *film.crop_offset()))


def prepare(scene: Any = 0, **options: Unpack[RenderOptions]) -> Prepared:
    """Read a scene and record its kernels once, for many renders of it; ``options`` are those of ``render``.

    .. code-block:: python

        again = mrt.prepare(scene, width=64, height=48, aa=1, aamode="none")
        again.params["ball.bsdf.alpha"] = 0.2
        result = again(seed=1)

    Kernels that trace more than one ray a pixel, that call plugins, or that filters follow, are not recorded
    but run as ``render`` does.
    """
    return Prepared(scene, RenderSettings.of(**options))
