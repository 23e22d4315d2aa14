"""Values of integrators along camera rays, from which the layers are made.

``shader_for`` chooses by capability: a ``LayeredIntegrator`` plans its kernels and knows layers of its own;
any other sampling integrator gives the picture, and Mitsuba the first hit.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.output.layers import FIRST_HIT, named
from mrt_mitsuba.plugins.kernel_plan import KernelPlan, SceneFacts
from mrt_mitsuba.plugins.parameters import ParameterError
from mrt_mitsuba.plugins.protocols import LayeredIntegrator
from mrt_mitsuba.rendering.view import View


class RayValues:
    """Values along camera rays, for the rows of the table of layers; what no row reads costs nothing."""

    spectrum: Any  # radiance with the sensor's weight
    image: Any  # its colour
    si: Any  # interaction at the first hit
    found: Any  # is there one
    valid: Any  # did the integrator find anything; Mitsuba's alpha
    aovs: Sequence[Any] = ()  # channels of the integrator's own

    def __init__(self, scene: Any, view: View, ray: Any, weight: Any) -> None:
        import mitsuba as mi

        self.scene, self.view, self.ray = scene, view, ray
        self.weight = mi.unpolarized_spectrum(weight)

    @property
    def distance(self) -> Any:
        """Distance of the first hit from the eye; inf for a miss."""
        import drjit as dr

        return dr.select(self.found, self.view.distance(self.si), dr.inf)

    @property
    def normal(self) -> Any:
        """Geometric normal at the first hit; 0 for a miss."""
        import drjit as dr
        import mitsuba as mi

        return dr.select(self.found, mi.Vector3f(self.si.n), 0)

    @property
    def position(self) -> Any:
        """Place of the first hit; 0 for a miss."""
        import drjit as dr
        import mitsuba as mi

        return dr.select(self.found, mi.Vector3f(self.si.p), 0)

    @property
    def uv(self) -> Any:
        """Texture coordinates of the first hit; 0 for a miss."""
        import drjit as dr
        import mitsuba as mi

        return dr.select(self.found, mi.Vector2f(self.si.uv), 0)

    @property
    def shape(self) -> Any:
        """Number of the scene's shape that is hit first, from 1; 0 for a miss."""
        import drjit as dr
        import mitsuba as mi

        from mrt_mitsuba.plugins.lookup import ByShape

        hit, shapes = mi.SurfaceInteraction3f(self.si), self.scene.shapes()
        if mi.variant().startswith("scalar"):
            hit.shape = hit.instance or hit.shape
        else:
            hit.shape = dr.select(hit.instance != None, hit.instance, hit.shape)  # noqa: E711 - lane by lane
        return ByShape(mi.Float, shapes, range(1, len(shapes) + 1), 0.0)(hit, self.found)

    @property
    def material(self) -> Any:
        """Number of the material that is hit first, from 1 in the order of the shapes; 0 for a miss, and in
        an instance."""
        import mitsuba as mi

        from mrt_mitsuba.plugins.lookup import ByShape

        shapes, numbers = self.scene.shapes(), dict[int, int]()
        materials = [shape.bsdf() for shape in shapes]  # kept, so that each has an id of its own
        rows = [numbers.setdefault(id(material), len(numbers) + 1) for material in materials]
        return ByShape(mi.Float, shapes, rows, 0.0)(self.si, self.found)

    @property
    def albedo(self) -> Any:
        """Diffuse reflectance at the first hit; 0 for a miss."""
        import drjit as dr
        import mitsuba as mi

        albedo = mi.UnpolarizedSpectrum(0)
        if not mi.variant().startswith("scalar") or self.found:
            bsdf = self.si.bsdf(mi.RayDifferential3f(self.ray))
            albedo = bsdf.eval_diffuse_reflectance(self.si, self.found)
        return to_rgb(dr.select(self.found, albedo, 0), self.ray)

    def rgb(self, spectrum: Any) -> Any:
        """Return the linear sRGB of a radiance along the rays, with the sensor's weight."""
        return to_rgb(spectrum * self.weight, self.ray)


class SampledValues(RayValues):
    """Values of any sampling integrator: the picture; Mitsuba knows the first hit."""

    def __init__(self, scene: Any, view: View, ray: Any, weight: Any, sample: tuple[Any, Any, Any]) -> None:
        import mitsuba as mi

        super().__init__(scene, view, ray, weight)
        spectrum, self.valid, self.aovs = sample
        self.spectrum = mi.unpolarized_spectrum(spectrum) * self.weight
        self.image = to_rgb(self.spectrum, ray)

    @cached_property
    def si(self) -> Any:
        import mitsuba as mi

        return self.scene.ray_intersect(mi.Ray3f(self.ray))

    @property
    def found(self) -> Any:
        return self.si.is_valid()


class LayeredValues(RayValues):
    """Values of a ``LayeredIntegrator``, all from what its ``trace`` returns."""

    def __init__(self, scene: Any, view: View, ray: Any, weight: Any, trace: Any) -> None:
        super().__init__(scene, view, ray, weight)
        self.trace, self.spectrum = trace, trace.radiance * self.weight
        self.image = to_rgb(self.spectrum, ray)
        self.si, self.found = trace.hit.si, trace.hit.found
        self.valid = self.found

    @property
    def direct(self) -> Any:
        """Light that needs no mirror ray."""
        return self.rgb(self.trace.direct)

    @property
    def reflection(self) -> Any:
        """Light that mirror rays add."""
        return self.rgb(self.trace.radiance - self.trace.direct)

    @property
    def bounces(self) -> Any:
        """Number of mirror rays."""
        import mitsuba as mi

        return mi.Float(self.trace.bounces)

    @property
    def shadow_rays(self) -> Any:
        """Number of shadow rays."""
        import mitsuba as mi

        return mi.Float(self.trace.shadow_rays)


class Shader:
    """A sampling integrator on a scene."""

    facts: SceneFacts | None = None  #: what its kernels depend on; None where it does not say
    kernel: KernelPlan | None = None  #: what its kernels hold
    random = True  #: does it draw random numbers

    def __init__(self, scene: Any, integrator: Any) -> None:
        self.scene, self.integrator = scene, integrator
        self.name = integrator.class_name()

    @property
    def layers(self) -> frozenset[str]:
        """Names of the layers that can be traced, but for internal ones."""
        return named(FIRST_HIT)

    def prepare(self, kernel: KernelPlan | None) -> None:
        """Get ready to trace by a plan of the kernels."""

    @property
    def aovs(self) -> tuple[str, ...]:
        """Names of the integrator's own channels."""
        return tuple(self.integrator.aov_names())

    def values(self, view: View, ray: Any, weight: Any, sampler: Any) -> RayValues:
        """Return what is known along rays with these weights."""
        import mitsuba as mi

        medium = view.sensor.get_medium()  # that the camera is in
        sample = self.integrator.sample(self.scene, sampler, mi.RayDifferential3f(ray), medium)
        return SampledValues(self.scene, view, ray, weight, sample)


class DerivativeShader(Shader):
    """An integrator for derivatives, such as ``prb``, which gives a picture as others do."""

    def __init__(self, scene: Any, integrator: Any) -> None:
        super().__init__(scene, integrator)
        self.name = type(integrator).__name__

    def values(self, view: View, ray: Any, weight: Any, sampler: Any) -> RayValues:
        import drjit as dr
        import mitsuba as mi

        radiance, valid, aovs, _ = self.integrator.sample(
            mode=dr.ADMode.Primal,
            scene=self.scene,
            sampler=sampler,
            ray=mi.RayDifferential3f(ray),
            depth=mi.UInt32(0),
            δL=None,
            δaovs=None,
            state_in=None,
            active=mi.Bool(True),
        )
        return SampledValues(self.scene, view, ray, weight, (radiance, valid, aovs))


class WholeShader(Shader):
    """An integrator that gives whole pictures only, such as ``ptracer``, which starts at the lamps."""

    layers = frozenset()


class LayeredShader(Shader):
    """A ``LayeredIntegrator`` on a scene, such as ``mrt_whitted``."""

    def __init__(self, scene: Any, integrator: Any) -> None:
        super().__init__(scene, integrator)
        try:
            self._reading = integrator.read(scene)
        except ParameterError as error:
            raise SceneError(str(error)) from None
        self.facts, self._data = self._reading.facts, None
        self.kernel = integrator.kernel_plan(self.facts)
        self.random = self.kernel.random
        self.name = integrator.plugin_name

    @property
    def layers(self) -> frozenset[str]:
        return super().layers | self.integrator.provided_layers()

    def prepare(self, kernel: KernelPlan | None) -> None:
        self._data = self.integrator.prepare(self.scene, kernel, self._reading)

    def values(self, view: View, ray: Any, weight: Any, sampler: Any) -> RayValues:
        trace = self.integrator.trace(self.scene, sampler, ray, True, self._data)
        return LayeredValues(self.scene, view, ray, weight, trace)


def shader_for(scene: Any, integrator: Any) -> Shader:
    """Return the shader that an integrator is capable of."""
    import mitsuba as mi

    kind: type[Shader] = WholeShader
    if isinstance(integrator, LayeredIntegrator):
        kind = LayeredShader
    elif isinstance(integrator, mi.CppADIntegrator):
        kind = DerivativeShader
    elif isinstance(integrator, mi.SamplingIntegrator) and "StokesIntegrator" not in repr(integrator):
        kind = Shader  # Mitsuba would crash in a sample of stokes, also inside another
    return kind(scene, integrator)


def components(value: Any) -> list[Any]:
    """Return the channels of a layer's value."""
    import drjit as dr

    return list(value) if dr.size_v(value) > 1 else [value]


def to_rgb(spectrum: Any, ray: Any) -> Any:
    """Return the linear sRGB of a spectrum in the current variant."""
    import mitsuba as mi

    if mi.is_spectral:
        xyz = sum(
            mi.cie1931_xyz(wavelength) * value
            for wavelength, value in zip(ray.wavelengths, spectrum, strict=True)
        )
        return mi.xyz_to_srgb(xyz * (mi.MI_CIE_Y_NORMALIZATION / len(spectrum)))
    if mi.is_monochromatic:
        return mi.Color3f(spectrum[0])
    return mi.Color3f(spectrum)
