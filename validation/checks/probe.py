"""A BSDF asked in bulk: directions and samples as numpy arrays, whatever the variant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.plugins.lookup import aligned

Array = np.ndarray
SCALAR_SHARE = 1 / 64  # of the lanes that a vectorised variant gets: others call once for each


def is_scalar() -> bool:
    """Return whether the current variant takes one direction at a time."""
    return mi.variant().startswith("scalar")


class Lanes:
    """The base of dataclasses of arrays that have a row for each lane."""

    def only(self: Kept, keep: Any) -> Kept:
        """Return some of the lanes."""
        return type(self)(*(value[keep] for value in vars(self).values()))


Kept = TypeVar("Kept", bound=Lanes)


@dataclass(frozen=True)
class Samples(Lanes):
    """The returned values of ``sample`` for N lanes."""

    wo: Array  # [N, 3]
    pdf: Array  # [N]
    eta: Array  # [N]
    type: Array  # int [N]
    component: Array  # int [N]
    weight: Array  # [N, channels]

    @property
    def delta(self) -> Array:
        """Where the sample comes from a lobe that is one direction only. [N]"""
        return (self.type & int(mi.BSDFFlags.Delta)) != 0


def context(component: int | None = None, *, importance: bool = False) -> Any:
    """Return a ``BSDFContext`` for one component or all."""
    made = mi.BSDFContext(mi.TransportMode.Importance if importance else mi.TransportMode.Radiance)
    if component is not None:
        made.component = component
    return made


def interaction(wi: Any, uv: Any) -> Any:
    """Return a point of the plane z = 0, with its whole frame: bump and normal maps need it."""
    si = dr.zeros(mi.SurfaceInteraction3f, 1 if is_scalar() else dr.width(wi))
    si.wi, si.uv, si.t = wi, uv, 1
    si.n, si.p = mi.Normal3f(0, 0, 1), mi.Point3f(uv.x, uv.y, 0)
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    return at_wavelengths(si)


def at_wavelengths(si: Any) -> Any:
    """Give an interaction wavelengths, where the variant has them."""
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(450, 500, 550, 600)
    return si


class Probe:
    """Calls one BSDF; directions [N, 3] in its frame, texture coordinates [N, 2], random numbers [N, 3]."""

    def __init__(self, bsdf: Any) -> None:
        self.bsdf = bsdf

    def eval(self, wi: Array, wo: Array, uv: Array, ctx: Any = None) -> Array:
        """Return f |cos θo|. [N, channels]"""
        return self._directions(lambda c, si, o: [self.bsdf.eval(c, si, o)], wi, wo, uv, ctx)[0]

    def pdf(self, wi: Array, wo: Array, uv: Array, ctx: Any = None) -> Array:
        """Return the density per solid angle. [N]"""
        return self._directions(lambda c, si, o: [self.bsdf.pdf(c, si, o)], wi, wo, uv, ctx)[0][:, 0]

    def both(self, wi: Array, wo: Array, uv: Array, ctx: Any = None) -> tuple[Array, Array]:
        """Return what ``eval`` and ``pdf`` give, each by itself."""
        pair = self._directions(
            lambda c, si, o: [self.bsdf.eval(c, si, o), self.bsdf.pdf(c, si, o)], wi, wo, uv, ctx
        )
        return pair[0], pair[1][:, 0]

    def pair(self, wi: Array, wo: Array, uv: Array, ctx: Any = None) -> tuple[Array, Array]:
        """Return what ``eval_pdf`` gives."""
        pair = self._directions(lambda c, si, o: self.bsdf.eval_pdf(c, si, o), wi, wo, uv, ctx)
        return pair[0], pair[1][:, 0]

    def inactive(self, wi: Array, wo: Array, uv: Array) -> list[Array]:
        """Return the values of ``eval`` and ``eval_pdf`` in lanes that ``active`` switches off."""

        def call(c: Any, si: Any, o: Any) -> list[Any]:
            off = o.z > 2  # no lane
            return [self.bsdf.eval(c, si, o, off), self.bsdf.eval_pdf(c, si, o, off)[0]]

        return self._directions(call, wi, wo, uv, None)

    def sample(self, wi: Array, u: Array, uv: Array, ctx: Any = None) -> Samples:
        """Return what ``sample`` gives."""
        ctx = ctx or context()

        def call(mi: Any, i: Any, t: Any, first: Any, second: Any) -> list[Any]:
            bs, weight = self.bsdf.sample(ctx, interaction(i, t), first, second)
            return [bs.wo, bs.pdf, bs.eta, bs.sampled_type, bs.sampled_component, _unpolarized(weight)]

        kinds = ("Vector3f", wi), ("Point2f", uv), ("Float", u[:, 0]), ("Point2f", u[:, 1:])
        wo, pdf, eta, kind, component, weight = lanes(call, *kinds)
        kinds_of, components = (x[:, 0].astype(np.int64) for x in (kind, component))
        return Samples(wo, pdf[:, 0], eta[:, 0], kinds_of, components, weight)

    def _directions(self, call: Callable[..., Any], wi: Array, wo: Array, uv: Array, ctx: Any) -> list[Array]:
        ctx = ctx or context()

        def evaluate(mi: Any, i: Any, o: Any, t: Any) -> list[Any]:
            return [_unpolarized(value) for value in call(ctx, interaction(i, t), o)]

        return lanes(evaluate, ("Vector3f", wi), ("Vector3f", wo), ("Point2f", uv))


def _unpolarized(value: Any) -> Any:
    return mi.unpolarized_spectrum(value) if dr.depth_v(value) > 1 else value


def not_finite(*values: Any, least: float = -np.inf) -> Any:
    """Return where any of several numbers or colours is not finite, or below ``least``."""
    bad = mi.Bool(False)
    for value in values:
        for component in [value] if dr.depth_v(value) == 1 else value:
            bad |= ~(component >= least) | ~dr.isfinite(component)
    return bad


def lanes(call: Callable[..., list[Any]], *columns: tuple[str, Array]) -> list[Array]:
    """Call ``call(mi, …)`` with columns [N] or [N, k] as Mitsuba types, in scalar variants once for each row.

    Return its values as arrays [N, k].
    """
    count = len(columns[0][1])
    if is_scalar():
        rows = [
            call(mi, *(getattr(mi, kind)(*np.atleast_1d(column[i]).tolist()) for kind, column in columns))
            for i in range(count)
        ]
        return [np.array([np.ravel(value) for value in values]) for values in zip(*rows, strict=True)]
    with dr.suspend_grad():
        found = call(mi, *(as_mitsuba(kind, column) for kind, column in columns))
        dr.eval(found)
    columns_of = ([value] if dr.depth_v(value) == 1 else value for value in found)
    return [np.stack([np.broadcast_to(np.array(x), count) for x in value], axis=-1) for value in columns_of]


def as_mitsuba(kind: str, column: Array) -> Any:
    """Return a column [N] or [N, k] as an array of the current variant, of a type of Mitsuba's.

    Dr.Jit compiles a kernel for every number of rows of a matrix, and for every alignment of memory.
    """
    return getattr(mi, kind)(*(aligned(row) for row in np.atleast_2d(column.T)))


def unit(v: Array) -> Array:
    """Return vectors [N, 3] made one unit long, in float32."""
    return (v / np.linalg.norm(v, axis=-1, keepdims=True)).astype(np.float32)


def direction(cos: Any, phi: Any) -> Array:
    """Return unit vectors by cosine to +z and azimuth, in float32. [N, 3]"""
    cos, phi = np.broadcast_arrays(np.asarray(cos, np.float64), phi)
    sin = np.sqrt((1 - cos) * (1 + cos))
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], axis=-1).astype(np.float32)
