"""Plugins called in bulk: directions and samples as numpy arrays, whatever the variant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

Array = np.ndarray
DIRECTION_EPS = 2.0**-23  # how far a direction is off that a computation returns in float32
BEYOND = "relative, beyond 8 times the effect of rounded directions"  # as ``excess`` has it
Part = TypeVar("Part", bound="Lanes")
Function = Callable[[Array], Array]
Call = Callable[..., Any]  # its values are a Dr.Jit array, or several


# Return types of methods that Mitsuba calls while it renders
RETURNS = {
    "eval": ("Spectrum",),
    "pdf": ("Float",),
    "eval_pdf": ("Spectrum", "Float"),
    "sample": ("BSDFSample3f", "Spectrum"),
    "eval_null_transmission": ("Spectrum",),
    "sample_direction": ("DirectionSample3f", "Spectrum"),
    "pdf_direction": ("Float",),
    "eval_direction": ("Spectrum",),
}


class Lanes(SimpleNamespace):
    """Arrays by name that have a row for each of N lanes."""

    def __getitem__(self: Part, keep: Any) -> Part:
        """Some of the lanes, selected as in an array."""
        return type(self)(**{name: column[keep] for name, column in vars(self).items()})

    def having(self: Part, **columns: Array) -> Part:
        """The same lanes with columns added or replaced."""
        return type(self)(**{**vars(self), **columns})


def joined(parts: Sequence[Part]) -> Part:
    """The lanes of several, one after the other."""
    first = parts[0]
    columns = {name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(first)}
    return type(first)(**columns)


def named(names: str, columns: Sequence[Array]) -> Lanes:
    """Lanes from columns and their space-separated names."""
    return Lanes(**dict(zip(names.split(), columns, strict=True)))


def corners(plugin: mi.Object) -> Array:
    """The least and the greatest corner of a bounding box. [2, 3]"""
    box = plugin.bbox()
    return np.array([np.ravel(np.array(corner, np.float64)) for corner in (box.min, box.max)])


def is_scalar() -> bool:
    """True if the current variant is scalar."""
    return mi.variant().startswith("scalar")


def context(
    component: int | None = None, *, importance: bool = False, type_mask: int | None = None
) -> mi.BSDFContext:
    """A ``BSDFContext`` for one component or all, and for some types of lobes or all."""
    ctx = mi.BSDFContext()
    if importance:
        ctx.mode = mi.TransportMode.Importance
    if component is not None:
        ctx.component = component
    if type_mask is not None:
        ctx.type_mask = type_mask
    return ctx


def interaction(wi: mi.Vector3f, uv: mi.Point2f) -> mi.SurfaceInteraction3f:
    """A point of the plane z = 0, with its whole frame: bump and normal maps need it."""
    si = dr.zeros(mi.SurfaceInteraction3f, 1 if is_scalar() else dr.width(wi))
    si.wi = wi
    si.uv = uv
    si.t = 1
    si.n = mi.Normal3f(0, 0, 1)
    si.p = mi.Point3f(uv.x, uv.y, 0)
    si.dp_du = mi.Vector3f(1, 0, 0)
    si.dp_dv = mi.Vector3f(0, 1, 0)
    si.sh_frame = mi.Frame3f(si.dp_du, si.dp_dv, mi.Vector3f(0, 0, 1))
    return at_wavelengths(si)


def at_wavelengths(si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
    """Give an interaction wavelengths, where the variant has them."""
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(450, 500, 550, 600)
    return si


def _cast(value: object, kind: str) -> Any:
    """Return a value as Mitsuba converts it: a number also counts as a color."""
    wanted = getattr(mi, kind)
    return value if isinstance(value, wanted) else wanted(value)


def method(plugin: mi.Object, name: str) -> Call:
    """A method of a plugin as Mitsuba calls it: with ``active``, and of certain types.

    It raises ``TypeError`` where the plugin returns another type.
    """

    def call(*given: object, active: mi.Bool = True) -> Any:
        answer = getattr(plugin, name)(*given, mi.Bool(active))
        kinds = RETURNS[name]
        parts = answer if isinstance(answer, tuple | list) else (answer,)
        try:
            taken = [_cast(part, kind) for part, kind in zip(parts, kinds, strict=True)]
        except (TypeError, ValueError) as problem:
            what = ", ".join(type(part).__name__ for part in parts)
            raise TypeError(f"{name}() returned {what}: it must return {', '.join(kinds)}") from problem
        return taken if len(kinds) > 1 else taken[0]

    return call


class Probe:
    """Calls one BSDF for lanes: ``wi`` and ``wo`` [N, 3] in its frame, ``uv`` [N, 2], ``u`` [N, 3].

    ``wi`` and ``uv`` may also be the same for all lanes: [3] and [2].
    """

    def __init__(self, bsdf: mi.BSDF) -> None:
        self.plugin = bsdf

    def ask(self, call: Call, at: Lanes, ctx: mi.BSDFContext | None = None, given: str = "wo") -> list[Array]:
        """The values of ``call(context, interaction, wo)``, or of another column ``given``, as arrays."""
        third = vars(at)[given]
        count = len(third)
        wi = np.broadcast_to(at.wi, (count, 3))
        uv = np.broadcast_to(at.uv, (count, 2))

        def values(i: mi.Vector3f, t: mi.Point2f, o: mi.Vector3f) -> object:
            return call(ctx or context(), interaction(i, t), o)

        return lanes(values, ("Vector3f", wi), ("Point2f", uv), ("Vector3f", third))

    def eval(self, at: Lanes, ctx: mi.BSDFContext | None = None) -> Array:
        """f |cos θo|. [N, channels]"""
        return self.ask(method(self.plugin, "eval"), at, ctx)[0]

    def pdf(self, at: Lanes, ctx: mi.BSDFContext | None = None) -> Array:
        """The density per solid angle. [N]"""
        return self.ask(method(self.plugin, "pdf"), at, ctx)[0]

    def both(self, at: Lanes, ctx: mi.BSDFContext | None = None) -> list[Array]:
        """``eval`` and ``pdf``, each by itself."""
        return [self.eval(at, ctx), self.pdf(at, ctx)]

    def pair(self, at: Lanes, ctx: mi.BSDFContext | None = None) -> list[Array]:
        """The two of ``eval_pdf``."""
        return self.ask(method(self.plugin, "eval_pdf"), at, ctx)

    def sample(self, at: Lanes, ctx: mi.BSDFContext | None = None) -> Lanes:
        """The lanes with a sample each: ``wo`` [N, 3], ``weight`` [N, channels], the others [N].

        ``delta``: whether it is from a lobe of one direction only; ``lit``: whether its weight is not 0;
        ``lobe``: the index of its component; ``flags``: those of the lobe. Directions that are not finite
        become 0.
        """

        sample = method(self.plugin, "sample")

        def call(c: mi.BSDFContext, si: mi.SurfaceInteraction3f, u: mi.Vector3f) -> list[object]:
            bs, weight = sample(c, si, u.x, mi.Point2f(u.y, u.z))
            return [bs.wo, bs.pdf, bs.eta, bs.sampled_type, bs.sampled_component, weight]

        wo, pdf, eta, flags, lobe, weight = self.ask(call, at, ctx, "u")
        flags = flags.astype(np.int64)
        return at.having(
            wo=np.where(np.isfinite(wo).all(axis=1, keepdims=True), wo, 0),
            pdf=pdf,
            eta=eta,
            flags=flags,
            lobe=lobe.astype(np.int64),
            weight=weight,
            delta=(flags & mi.BSDFFlags.Delta) != 0,
            lit=(weight != 0).any(axis=1),
        )


def lanes(call: Call, *columns: tuple[str, Array]) -> list[Array]:
    """Call ``call`` with columns [N] or [N, k] as Mitsuba types, in scalar variants once for each row.

    The values come back as arrays [N] or [N, k]; those of polarized light are the intensity.
    """
    count = len(columns[0][1])
    if is_scalar():
        rows = []
        kinds, arrays = zip(*columns, strict=True)
        for row in zip(*arrays, strict=True):
            numbers = zip(kinds, row, strict=True)
            arguments = [getattr(mi, kind)(*np.atleast_1d(number).tolist()) for kind, number in numbers]
            rows.append([np.asarray(value) for value in _values(call, arguments)])
        return [np.array(values) for values in zip(*rows, strict=True)]
    with dr.suspend_grad():
        values = _values(call, [as_mitsuba(kind, column) for kind, column in columns])
        dr.eval(values)
    arrays = []
    for value in values:
        if dr.depth_v(value) == 1:
            arrays.append(np.broadcast_to(np.array(value), count))
        else:  # sums over channels are quicker so
            arrays.append(np.array([np.broadcast_to(np.array(channel), count) for channel in value]).T)
    return arrays


def _values(call: Call, arguments: Sequence[object]) -> list[Any]:
    """The values of a call; those of polarized light are the intensity."""
    values = call(*arguments)
    several = values if isinstance(values, list | tuple) else [values]
    return [mi.unpolarized_spectrum(value) if dr.is_matrix_v(value) else value for value in several]


def as_mitsuba(kind: str, column: Array) -> Any:
    """A column [N] or [N, k] as an array of the current variant, of a type of Mitsuba's.

    Dr.Jit compiles a kernel for every number of rows of a matrix, and for every alignment of memory.
    """
    rows = np.atleast_2d(column.T)
    return getattr(mi, kind)(*map(_aligned, rows))


def _aligned(row: Array) -> mi.Float:
    """Numbers as a flat array, at a multiple of 64 bytes."""
    room: Array = np.empty(len(row) + 16, np.float32)
    start = -room.ctypes.data % 64 // 4
    place = room[start : start + len(row)]
    place[:] = row
    return mi.Float(place)


def unit(v: Array) -> Array:
    """Vectors [N, 3] made one unit long, in float32."""
    return np.float32(v / np.linalg.norm(v, axis=-1, keepdims=True))


def direction(cos: Array | float, phi: Array | float) -> Array:
    """Unit vectors by cosine to +z and azimuth, in float32. [N, 3]"""
    cos, phi = np.broadcast_arrays(np.asarray(cos, np.float64), phi)
    sin = np.sqrt((1 - cos) * (1 + cos))
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], axis=-1).astype(np.float32)


def spread(
    quantity: Callable[..., Array],
    directions: Sequence[Array],
    rng: np.random.Generator,
    by: float = DIRECTION_EPS,
) -> Array:
    """The largest change of a quantity of directions [N, 3] as they move ``by`` so much."""
    base = quantity(*directions)
    largest = np.zeros_like(base)
    for _ in range(6):
        moved = [v + by * rng.normal(size=v.shape).astype(np.float32) for v in directions]
        change = abs(quantity(*moved) - base)
        largest = np.maximum(largest, np.where(np.isnan(change), np.inf, change))
    return largest


def finite_or_0(values: Array) -> Array:
    """Values, and 0 for those that are not finite, which are left to the law ``finite``."""
    return np.nan_to_num(values, posinf=0, neginf=0)


def without_density(value: Array, pdf: Array) -> Array:
    """The share of all light [N, channels] that each direction carries, where its density [N] is 0. [N]"""
    light = finite_or_0(value).sum(axis=1)
    return np.where(pdf == 0, light, 0) / max(light.sum(), 1e-30)


def excess(one: Array, other: Array, allowed: Array | float = 0.0) -> Array:
    """Relative difference [N] of two arrays [N, …], beyond ``8 * allowed``, relative to the larger one.

    The brightest channel counts as the size; below 1e-20, an exponential may have underflowed or not. What is
    not finite is left to the law ``finite``.
    """
    allowed = np.broadcast_to(allowed, one.shape)
    one, other, allowed = (np.reshape(x, (len(one), -1)).astype(np.float64) for x in (one, other, allowed))
    size = np.maximum(abs(one), abs(other)).max(axis=1, keepdims=True)
    size = np.where(size > 1e-20, size, np.inf)
    beyond = np.maximum(abs(one - other) - 8 * allowed, 0) / size
    return np.where(np.isfinite(beyond), beyond, 0).max(axis=1)
