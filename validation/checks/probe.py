"""Plugins asked in bulk: directions and samples as numpy arrays, whatever the variant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.plugins.variants import aligned

Array = np.ndarray
ROUNDED = 2.0**-23  # how far a direction is off that a computation returns in float32
BEYOND = "relative, beyond 8 times what the rounding of directions explains"  # as ``excess`` has it
Part = TypeVar("Part", bound="Lanes")


class Lanes(SimpleNamespace):
    """Arrays by name that have a row for each of N lanes."""

    def only(self: Part, keep: Any) -> Part:
        """Return some of the lanes."""
        return type(self)(**{name: column[keep] for name, column in vars(self).items()})


def joined(parts: Sequence[Part]) -> Part:
    """Return the lanes of several, one after the other."""
    return type(parts[0])(**{name: np.concatenate([vars(p)[name] for p in parts]) for name in vars(parts[0])})


def is_scalar() -> bool:
    """Return whether the current variant takes one direction at a time."""
    return mi.variant().startswith("scalar")


def context(component: int | None = None, *, importance: bool = False) -> Any:
    """Return a ``BSDFContext`` for one component or all."""
    mode = mi.TransportMode.Importance if importance else mi.TransportMode.Radiance
    return mi.BSDFContext(mode, mi.BSDFContext().type_mask, component)


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
    """Calls one BSDF: wi [N, 3] or [3] and wo [N, 3] in its frame, uv [N, 2] or [2], u [N, 3]."""

    def __init__(self, bsdf: Any) -> None:
        self.plugin = bsdf

    def ask(self, call: Callable[..., Any], wi: Array, wo: Array, uv: Array, ctx: Any = None) -> list[Array]:
        """Return as arrays what ``call(context, interaction, wo)`` gives."""
        wi, uv = (np.broadcast_to(x, (len(wo), x.shape[-1])) for x in (wi, uv))
        columns = ("Vector3f", wi), ("Point2f", uv), ("Vector3f", wo)
        return lanes(lambda i, t, o: call(ctx or context(), interaction(i, t), o), *columns)

    def eval(self, wi: Array, wo: Array, uv: Array, ctx: Any = None) -> Array:
        """Return f |cos θo|. [N, channels]"""
        return self.ask(lambda *at: [self.plugin.eval(*at)], wi, wo, uv, ctx)[0]

    def pdf(self, wi: Array, wo: Array, uv: Array, ctx: Any = None) -> Array:
        """Return the density per solid angle. [N]"""
        return self.ask(lambda *at: [self.plugin.pdf(*at)], wi, wo, uv, ctx)[0]

    def both(self, wi: Array, wo: Array, uv: Array, ctx: Any = None) -> list[Array]:
        """Return what ``eval`` and ``pdf`` give, each by itself."""
        return self.ask(lambda *at: [self.plugin.eval(*at), self.plugin.pdf(*at)], wi, wo, uv, ctx)

    def pair(self, wi: Array, wo: Array, uv: Array, ctx: Any = None) -> list[Array]:
        """Return what ``eval_pdf`` gives."""
        return self.ask(lambda *at: self.plugin.eval_pdf(*at), wi, wo, uv, ctx)

    def sample(self, wi: Array, u: Array, uv: Array, ctx: Any = None) -> Lanes:
        """Return what ``sample`` gives: ``wo`` [N, 3], ``weight`` [N, channels], the others [N].

        ``delta``: whether it is from a lobe of one direction only; ``lit``: whether its weight is not 0.
        """

        def call(c: Any, si: Any, u: Any) -> list[Any]:
            bs, weight = self.plugin.sample(c, si, u.x, mi.Point2f(u.y, u.z))
            return [bs.wo, bs.pdf, bs.eta, bs.sampled_type, bs.sampled_component, weight]

        names = ("wo", "pdf", "eta", "type", "component", "weight")
        s = Lanes(**dict(zip(names, self.ask(call, wi, u, uv, ctx), strict=True)))
        s.type, s.component = s.type.astype(np.int64), s.component.astype(np.int64)
        s.delta, s.lit = (s.type & int(mi.BSDFFlags.Delta)) != 0, (s.weight != 0).any(axis=1)
        return s


def not_finite(*values: Any, least: float = -np.inf) -> Any:
    """Return where any of several numbers or colours is not finite, or below ``least``."""
    bad = mi.Bool(False)
    for value in values:
        for component in [value] if dr.depth_v(value) == 1 else value:
            bad |= ~(component >= least) | ~dr.isfinite(component)
    return bad


def lanes(call: Callable[..., Any], *columns: tuple[str, Array]) -> list[Array]:
    """Call ``call`` with columns [N] or [N, k] as Mitsuba types, in scalar variants once for each row.

    Return its values as arrays [N] or [N, k]; of polarized light, the intensity.
    """

    def plain(value: Any) -> Any:
        return mi.unpolarized_spectrum(value) if dr.is_matrix_v(value) else value

    count = len(columns[0][1])
    if is_scalar():
        rows = [
            call(*(getattr(mi, kind)(*np.atleast_1d(column[i]).tolist()) for kind, column in columns))
            for i in range(count)
        ]
        return [np.array([np.asarray(plain(x)) for x in values]) for values in zip(*rows, strict=True)]
    with dr.suspend_grad():
        found = [plain(value) for value in call(*(as_mitsuba(kind, column) for kind, column in columns))]
        dr.eval(found)
    return [
        np.array([np.broadcast_to(np.array(x), count) for x in value]).T  # sums over channels are quicker so
        if dr.depth_v(value) > 1
        else np.broadcast_to(np.array(value), count)
        for value in found
    ]


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


def spread(
    quantity: Callable[..., Array], directions: Sequence[Array], rng: np.random.Generator, by: float = ROUNDED
) -> Array:
    """Return the largest change of a quantity of directions [N, 3] as they move ``by`` so much."""
    base = quantity(*directions)
    moved = ([v + by * rng.normal(size=v.shape).astype(np.float32) for v in directions] for _ in range(6))
    changes = np.abs([quantity(*at) - base for at in moved])
    return np.where(np.isnan(changes), np.inf, changes).max(axis=0)


def excess(one: Array, other: Array, allowed: Array | float = 0.0) -> Array:
    """Return [N]: how far two arrays [N, …] differ beyond ``8 * allowed``, relative to the larger one.

    The brightest channel counts as the size; below 1e-20, an exponential may have underflowed or not. What is
    not finite is left to the law ``finite``.
    """
    allowed = np.broadcast_to(allowed, one.shape)
    one, other, allowed = (np.reshape(x, (len(one), -1)).astype(np.float64) for x in (one, other, allowed))
    size = np.maximum(np.abs(one), np.abs(other)).max(axis=1, keepdims=True)
    beyond = np.maximum(np.abs(one - other) - 8 * allowed, 0) / np.where(size > 1e-20, size, np.inf)
    return np.where(np.isfinite(beyond), beyond, 0).max(axis=1)
