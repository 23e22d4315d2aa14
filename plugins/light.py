"""``mrt_light``: the report's point light, as bright far away as near by."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .parameters import ParameterError, spectrum, vector
from .variants import first, is_jit, pointer, varies
from .whitted.lights import towards


class MrtLight(mi.Emitter):
    r"""Point light without distance falloff.

    A surface point receives ``intensity`` from the direction of ``position``, whatever the distance d; a
    physical point light would give intensity/d².

    ============= ========== ========== ==========================================================
    name          type       default    unit or range
    ============= ========== ========== ==========================================================
    ``position``  point      (0, 0, 0)  scene units
    ``intensity`` spectrum   1          irradiance at normal incidence, at any distance; may exceed 1
    ============= ========== ========== ==========================================================

    .. code-block:: python

        {'type': 'mrt_light', 'position': [3, 2, 3], 'intensity': {'type': 'rgb', 'value': 2.0}}

    .. code-block:: xml

        <emitter type="mrt_light">
            <point name="position" x="3" y="2" z="3"/>
            <rgb name="intensity" value="2"/>
        </emitter>

    Nearest stock plugin: ``point``, which falls off with the squared distance. ``position`` places the light,
    so ``to_world`` is refused. So is light tracing (``ptracer``): a light without falloff emits no finite
    power.
    """

    def __init__(self, props: mi.Properties) -> None:
        mi.Emitter.__init__(self, props)
        if "to_world" in props:
            raise ParameterError(
                f'{props.plugin_name()}: "to_world" is not accepted; give "position" in world space'
            )
        self.position = mi.Point3f(vector(props, "position", (0, 0, 0)))
        self.intensity = spectrum(props, "intensity", 1.0, emissive=True)
        self.m_flags = +mi.EmitterFlags.DeltaPosition
        dr.make_opaque(self.position)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("position", self.position, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)
        callback.put("intensity", self.intensity, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        dr.make_opaque(self.position)

    def _irradiance(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.UnpolarizedSpectrum:
        """Return the intensity at the wavelengths of ``it``."""
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wavelengths = it.wavelengths
        return self.intensity.eval(si, active)

    def fixed_row(self) -> list[list[float]] | None:
        """Return position and intensity as plain numbers; None where they vary, or where derivatives are
        wanted.
        """
        if varies(self.intensity):
            return None
        row = [self.position, self._irradiance(dr.zeros(mi.Interaction3f))]
        if dr.grad_enabled(row):
            return None
        return [(3 * [first(x) for x in part])[:3] for part in row]  # of a single channel, three

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        ds = towards(self.position, it)
        ds.emitter = pointer(self)
        return ds, mi.depolarizer(self._irradiance(it, active))

    def pdf_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Float:
        return mi.Float(0)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Spectrum:
        return mi.depolarizer(dr.select(active, self._irradiance(it, active), 0))

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        return mi.Spectrum(0)

    # Dr.Jit calls these for scenes without such a light, too, if there is one elsewhere: they cannot refuse

    def sample_ray(self, *_: object) -> tuple[mi.Ray3f, mi.Spectrum]:
        return dr.zeros(mi.Ray3f), mi.Spectrum(0)

    def sample_position(self, *_: object) -> tuple[mi.PositionSample3f, mi.Float]:
        return dr.zeros(mi.PositionSample3f), mi.Float(0)

    def sample_wavelengths(
        self, si: mi.SurfaceInteraction3f, *_: object
    ) -> tuple[mi.Wavelength, mi.Spectrum]:
        return si.wavelengths, mi.Spectrum(0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        p = mi.ScalarPoint3f(list(map(first, self.position)))
        # Scalar variants have no second name for it
        return mi.ScalarBoundingBox3f(p, p) if is_jit() else mi.BoundingBox3f(p, p)

    def to_string(self) -> str:
        return f"{type(self).__name__}[position={self.position}, intensity={self.intensity}]"
