"""``check_emitter``: the laws that any emitter must obey, stock or in Python; see ``bsdf``."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property, partial

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.linalg import norm

from . import probe
from .case import READS, READS_WHY, WAVE, Case, Given, reads_checked
from .examine import examine
from .faults import DEGREE, PLACE, larger, no_number, put
from .law import (
    SIGMAS,
    Outcome,
    Skip,
    UsageError,
    by_name,
    difference,
    finds,
    measures,
    most,
    number_of,
    p_value,
)
from .page import Check
from .probe import BEYOND, Array, Lanes, excess, lanes, method, named
from .shape_case import CONE, View, alone
from .sphere import (
    SMALL_CELL_LEVEL,
    Cells,
    compared,
    encode,
    hold_small,
)

REEVALUATION_TOL = 1e-3  # relative: the same formula, evaluated once more
DIRECTION_TOL = 4 * probe.DIRECTION_EPS  # a direction passes through angles, a transform, and back
SPOILS = "one such number spoils a picture"
LENGTH_TOL = 1e-4  # relative: a square root, and the difference of two points
MAX_UNSAMPLED_LIGHT = 5e-5  # share of the light: a fifth of a cone of 3 degrees


SAMPLED = """ds, weight = emitter.sample_direction(it, mi.Point2f({number}))
print("a sample of", ds.d, "distance", ds.dist, "density", ds.pdf, "weight", weight)
print("there, pdf_direction():", emitter.pdf_direction(it, ds), "and", emitter.eval_direction(it, ds))
print("the point:", ds.p, "and by direction and distance:", it.p + ds.dist * ds.d)
it.wi = -ds.d
print("eval(), if it is infinitely far:", emitter.eval(it))
"""


def check_emitter(
    emitter: Given,
    *,
    scene: mi.Scene | None = None,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
) -> Check:
    """Check the laws of an emitter in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    ``scene``: the one that a loaded emitter belongs to; else it lights a sphere of radius 1, and what lights
    from a surface does so from a square. A dict may also be of a shape with an emitter. ``quick``:
    fewer samples. ``only``: names of ``LAWS``.
    Raises ``UsageError`` for anything else, and ``LoadError`` for a dict that Mitsuba cannot load.
    """
    case = partial(EmitterCase, scene=scene)
    return examine(case, emitter, LAWS, quick=quick, seed=seed, only=only)


class EmitterCase(Case):
    """An emitter of a scene, and points in and around its box from which it is looked at [N, 3]."""

    word = "emitter"

    def __init__(self, given: Given, quick: bool, seed: int, scene: mi.Scene | None = None) -> None:
        super().__init__(given, quick, seed)
        if self.description and isinstance(self.plugin, mi.Emitter) and self._has(mi.EmitterFlags.Surface):
            self.description = {"type": "rectangle", "light": self.description}  # some surface to light from
            self.plugin = self.load()
        nodes = '"ball": {"type": "sphere"}, "light": emitter'
        if isinstance(self.plugin, mi.Shape) and self.plugin.emitter() is not None:
            nodes = '"shape": emitter'
            scene = mi.load_dict({"type": "scene", "shape": self.plugin})
            self.plugin = self.plugin.emitter()
        self.need("an emitter", isinstance(self.plugin, mi.Emitter))
        if scene is None and self._has(mi.EmitterFlags.Surface):
            fix = "give the scene that it belongs to, or a dict of its shape"
            raise UsageError(f"the {self.name} cannot light a scene of its own: {fix}")
        # an emitter keeps neither its scene nor its shape alive
        self.lit = scene or mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "light": self.plugin})
        #: lines of a program that put the emitter into a scene
        self.placed = "# it is in a scene"
        if self.description is not None:
            self.placed = f'scene = mi.load_dict({{"type": "scene", {nodes}}})\n(emitter,) = scene.emitters()'
        # of a scene without shapes, the box is empty
        low, high = np.sort(np.nan_to_num(probe.corners(self.lit), posinf=1, neginf=-1), axis=0)
        size = float(norm(high - low))
        outer = 0.1 * size  # also across a flat box
        self.points = np.float32(self.rng.uniform(low - outer, high + outer, (2**12, 3)))
        self.eval = method(self.plugin, "eval")
        self._sample = method(self.plugin, "sample_direction")
        self._light = method(self.plugin, "eval_direction")
        self._density = method(self.plugin, "pdf_direction")
        # whether light comes from all around, or from a surface, and not from single directions or a point
        delta = self._has(mi.EmitterFlags.Delta)
        self.around = self._has(mi.EmitterFlags.Infinite) and not delta
        self.lamp = self._has(mi.EmitterFlags.Surface) and not delta

    def _has(self, flag: mi.EmitterFlags) -> bool:
        return bool(mi.has_flag(self.plugin.flags(), flag))

    @cached_property
    def samples(self) -> Lanes:
        """A sample for each point."""
        return self.sample(self.points)

    def sample(self, points: Array, extreme: float = 0) -> Lanes:
        """A sample for each point; ``again``: pdf_direction(), ``value``: eval_direction().

        ``extreme``: the share of random numbers at the ends of their range.
        """

        def call(p: mi.Point3f, u: mi.Point2f) -> list[mi.Float]:
            it = _seen_from(p)
            ds, weight = self._sample(it, u)
            again = self._density(it, ds)
            return [ds.p, ds.d, ds.dist, ds.pdf, again, ds.delta, weight, self._light(it, ds)]

        u = self.numbers(len(points), 2, extreme=extreme)
        try:
            columns = lanes(call, ("Point3f", points), ("Point2f", u))
        except (NotImplementedError, RuntimeError) as error:
            if not type(self.plugin).__module__.startswith("mitsuba"):
                raise
            raise Skip("directions cannot be sampled") from error
        s = named("p d dist pdf again delta weight value", columns).having(point=points, number=u)
        s.lit = (s.weight != 0).any(axis=1)
        return s

    def seen(self, d: Array) -> list[Array]:
        """The density of directions [N] and the light that is seen there [N, channels]."""

        def call(d: mi.Vector3f) -> list[mi.Float]:
            it = self.from_first()
            ds, _ = self._sample(it, mi.Point2f(0.5))
            ds.d = d
            it.wi = -d
            return [self._density(it, ds), self.eval(it)]

        return lanes(call, ("Vector3f", d))

    def met(self, o: Array, d: Array) -> Lanes:
        """Hits of rays with an emitter: ``met`` and ``t`` [N], eval() and eval_direction() [N, channels]."""

        def call(origin: mi.Point3f, direction: mi.Vector3f) -> list[mi.Float]:
            it = _seen_from(origin)
            si = probe.at_wavelengths(self.surface.ray_intersect(mi.Ray3f(origin, direction)))
            ds = mi.DirectionSample3f(self.surface, si, it)
            return [si.is_valid(), si.t, self.eval(si), self._light(it, ds)]

        return named("met t seen value", lanes(call, ("Point3f", o), ("Vector3f", d)))

    @cached_property
    def surface(self) -> mi.Scene:
        """A scene with the emitter's shape alone."""
        return alone(self.plugin.get_shape())

    @cached_property
    def view(self) -> View:
        """The view of that shape from all around."""
        return View(probe.corners(self.surface))

    @cached_property
    def glimpses(self) -> Lanes:
        """Hits of uniform rays from all around, as ``met`` has them."""
        o = self.view.around(self, self.count(2**17, 2**19))
        return self.met(o, self.view.into_cone(o, self.rng))

    def from_first(self) -> mi.SurfaceInteraction3f:
        """The first of the points."""
        return _seen_from(mi.Point3f(*map(float, self.points[0])))

    def density(self, d: Array) -> Array:
        """The density of directions, 0 where it is not finite. [N]"""
        return probe.finite_or_0(self.seen(d)[0])

    @cached_property
    def spread(self) -> tuple[Array, Array]:
        """Change of ``seen`` under rounding of directions; 0 for other lights."""
        s = self.samples
        if not self.around:
            return np.zeros_like(s.pdf), np.zeros_like(s.value)
        off = probe.spread(lambda d: np.column_stack(self.seen(d)), [s.d], self.rng, DIRECTION_TOL)
        return off[:, 0], off[:, 1:]


def _seen_from(p: mi.Point3f) -> mi.SurfaceInteraction3f:
    it = dr.zeros(mi.SurfaceInteraction3f)
    it.p = p
    return probe.at_wavelengths(it)


@finds("same", "pdf_direction() too large", 3e-3, pdf=larger)
@measures(
    same=most(
        f"density of a direction against pdf_direction(), {BEYOND}", REEVALUATION_TOL, "one number", SAMPLED
    )
)
def density(law: Outcome, case: EmitterCase) -> None:
    """The density that a sample states is ``pdf_direction``."""
    s = case.samples
    judged = s.lit & ~s.delta
    if not judged.any():
        raise Skip("light comes from single directions (delta), or none was sampled")
    law.check("same", excess(s.pdf, s.again, case.spread[0]), s, where=judged, placed=case.placed)


def in_hole(size, d):
    """Directions in a cone, so many degrees across."""
    return dr.norm(d - mi.Vector3f(PLACE)) < size * DEGREE / 2


def around_hole(size, ds, u):
    """Directions that are never in a cone: they go the other way."""
    d = dr.select(in_hole(size, ds.d), -ds.d, ds.d)
    return put(ds, p=ds.p + ds.dist * (d - ds.d), d=d)


def nothing_in_hole(size, value, *given):
    """No weight or density in a cone; the sample comes last."""
    return dr.select(in_hole(size, given[-1].d), 0, value)


def no_density_of_sample(size, ds, u):
    ds = around_hole(size, ds, u)
    return put(ds, pdf=nothing_in_hole(size, ds.pdf, ds))


@finds("small", "no samples in a cone, in degrees", 3, direction=around_hole)
@finds(
    "dark",
    "no density in a cone, in degrees",
    3,
    direction=no_density_of_sample,
    pdf=nothing_in_hole,
)
@measures(
    place=most(
        "sampled point off the stated direction and distance, relative",
        LENGTH_TOL,
        "one place, said in two ways",
        SAMPLED,
    ),
    small=p_value("smallest p-value of counts in small cells, corrected for their number"),
    slices=p_value("smallest p-value of counts in slices of one or two degrees, corrected for their number"),
    light=most(
        "light of an emitter by samples, against by rays in all directions, relative, beyond "
        f"{SIGMAS} standard errors",
        1e-2,
        "one integral, of weights and of eval(): samples, densities and what is seen agree",
    ),
    dark=number_of(
        "share of the light, from all around, whose density is 0",
        MAX_UNSAMPLED_LIGHT,
        "light that samples never find is missing from the picture",
    ),
)
def sampling(law: Outcome, case: EmitterCase) -> None:
    """p = o + dist · d; directions to light from all around follow their density."""
    s = case.samples
    if not s.lit.any():
        raise Skip("no sample carries light")
    points = np.float64(case.points)
    scale = abs(s.dist) + abs(points).max(axis=1)
    off = norm(s.p - points - s.dist[:, None] * s.d, axis=1)
    law.check("place", np.nan_to_num(off / scale), s, where=s.lit, placed=case.placed)
    if case.lamp:  # as much by samples as by rays
        o = case.view.around(case, case.count(2**15, 2**17))
        sampled = case.sample(o)
        hits = case.met(o, sampled.d)
        visible = hits.met & (hits.t > sampled.dist * (1 - 1e-3))
        by_samples = np.where(visible & sampled.lit, probe.finite_or_0(sampled.weight).sum(axis=1), 0)
        by_rays = np.where(case.glimpses.met, probe.finite_or_0(case.glimpses.seen).sum(axis=1) * CONE, 0)
        law.check("light", difference(by_samples, by_rays))
    if not case.around:
        return
    rng = np.random.default_rng((case.seed, 2))
    anywhere = probe.unit(rng.normal(size=(case.count(2**18, 2**20), 3)))
    pdf, value = case.seen(anywhere)
    law.check("dark", probe.without_density(value, pdf))
    _in_small_cells(law, case)


def _in_small_cells(law: Outcome, case: EmitterCase) -> None:
    """Directions in cells and in slices of a degree: for places never sampled."""
    if probe.is_scalar():
        law.notes.append("too few samples to compare with densities: check it in a vectorised variant")
        return
    count = case.count(2 * WAVE, 8 * WAVE)
    cells = Cells.uniform(SMALL_CELL_LEVEL)
    codes = []
    for _ in range(count // WAVE):
        s = case.sample(np.broadcast_to(case.points[0], (WAVE, 3)))
        refused = ~s.lit & (s.value > 0).any(axis=1)
        codes.append(encode(s.d[~refused]))
    rng = np.random.default_rng((case.seed, 3))
    counts = compared(cells, case.density, np.concatenate(codes), count, rng)
    hold_small(law, cells, counts, REEVALUATION_TOL)


@finds("weight", "weight of a sample too large", 3e-3, weight=larger)
@measures(
    weight=most(
        f"weight against eval_direction() / density, {BEYOND}", REEVALUATION_TOL, "one number", SAMPLED
    ),
    seen=most(f"eval() where it is seen against eval_direction(), {BEYOND}", REEVALUATION_TOL, "one number"),
)
def weights(law: Outcome, case: EmitterCase) -> None:
    """weight · pdf is ``eval_direction``, and so is ``eval`` where a ray meets the emitter."""
    s = case.samples
    allowed = case.spread[1]
    counts = s.lit & (s.pdf > 0) & np.isfinite(s.weight).all(axis=1)
    if not counts.any():
        raise Skip("no sample carries light")
    error = excess(s.weight * s.pdf[:, None], s.value, allowed)
    law.check("weight", error, s, where=counts, placed=case.placed)
    if case.around:
        _, value = case.seen(s.d)
        law.check("seen", excess(value, s.value, allowed), where=counts)
    if not case.around and not case.lamp:  # renders call it all the same
        case.eval(case.from_first())
    if case.lamp:  # also from within
        low, high = probe.corners(case.surface)
        goals = case.rng.uniform(low, high, case.points.shape)
        hits = case.met(case.points, probe.unit(goals - case.points))
        law.check("seen", excess(hits.seen, hits.value), where=hits.met)


@finds("bad", "NaN for a share of the random numbers", 1e-6, quick=4e-6, weight=no_number)
@measures(
    reads=most(READS, 0, READS_WHY),
    bad=number_of("samples that are not finite, or negative, or not of unit length", 0, SPOILS, SAMPLED),
    seen=number_of("values of eval(), where it is seen, that are not finite, or negative", 0, SPOILS),
)
def finite(law: Outcome, case: EmitterCase) -> None:
    """Samples are finite, directions have unit length, and weights and densities are not negative."""
    with reads_checked(law):
        one_point = np.broadcast_to(case.points[0], (WAVE, 3))
        for s in (case.sample(case.points, extreme=0.4), *(case.sample(one_point) for _ in case.waves)):
            sound = [np.isfinite(x) & (x >= 0) for x in (s.weight, s.value)]
            length = abs(norm(np.float64(s.d), axis=1) - 1)
            usable = (length <= LENGTH_TOL) & np.isfinite(s.dist) & (s.pdf >= 0)
            bad = ~np.all(sound, axis=(0, 2)) | (s.lit & ~usable)
            if bad.any() or not law.parts:
                law.check("bad", bad, s, placed=case.placed)
        seen = None
        if case.lamp:
            seen = case.glimpses.seen[case.glimpses.met]
        elif case.around:
            _, seen = case.seen(case.units(case.count(2**16, 2**18)))
        if seen is not None:
            law.check("seen", ~(np.isfinite(seen) & (seen >= 0)).all(axis=1))


LAWS = by_name(density, sampling, weights, finite)
