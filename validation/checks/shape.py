"""``check_shape``: the laws that any shape must obey, stock, mesh or in Python."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.checks.law import TIMEOUT, Check, Law, examine, settings_restored
from mrt_mitsuba.validation.checks.noise import ROUNDING
from mrt_mitsuba.validation.checks.probe import lanes
from mrt_mitsuba.validation.checks.recipe import elsewhere, other_kind
from mrt_mitsuba.validation.checks.shape_case import FLAT, HIT_ROUNDINGS, Case, corners, trace
from mrt_mitsuba.validation.checks.shape_range import far, finite, scale
from mrt_mitsuba.validation.checks.shape_samples import sampling
from mrt_mitsuba.validation.checks.shape_surface import hits, normals, surface, watertight


def check_shape(
    shape: Any,
    *,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
    timeout: float = TIMEOUT,
) -> Check:
    """Check the laws of a shape in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    Any other object that has ``ray_intersect``, ``ray_test`` and ``bbox`` will do as well.
    ``quick``: fewer rays. ``only``: names of ``LAWS``. ``timeout``: seconds after which a law fails that is
    not done. Raises ``UsageError`` for anything else, and ``SceneError`` for a dict that Mitsuba cannot load.
    """
    runtime.use()
    with settings_restored():
        case = Case(shape, quick, seed)
        return examine(case.name, case, LAWS, only=only, quick=quick, timeout=timeout)


def bbox(law: Law, case: Case) -> None:
    """Whatever is hit or sampled lies in the bounding box."""
    o, d, met = case.met
    points = [met.p]
    ends = corners(case.plugin)
    if ends is not None:
        points.append(ends)
    elif hasattr(case.plugin, "sample_position"):
        try:
            u = case.rng.random((len(o), 2), np.float32)
            points += lanes(lambda mi, x: [case.plugin.sample_position(0, x).p], ("Point2f", u))
        except RuntimeError:
            law.notes.append("sample_position() is not there")
    p = np.concatenate(points)
    out = np.maximum(case.box[0] - p, p - case.box[1]).max(axis=1) / case.size
    i = int(out.argmax())
    what = "points outside the bounding box, in sizes"
    why = "some roundings"
    law.at_most(what, max(out[i], 0), 1e-5, why, case.snippet(o[min(i, len(o) - 1)], d[min(i, len(o) - 1)]))


def variants(law: Law, case: Case) -> None:
    """Hits in the scalar variant against those in the vectorised one."""
    case.with_()
    other = other_kind()
    few = slice(0, case.count(500, 2000))
    o, d, seen = case.seen[0][few], case.seen[1][few], case.seen[2].only(few)
    there = elsewhere(other, lambda: trace(case.scene(), o, d))
    steep = np.abs((seen.n * d).sum(axis=1)) > FLAT
    bad = (there.found != seen.found) & (steep | ~seen.found)
    both = there.found & seen.found & steep
    scale = np.abs(o).max(axis=1) + seen.t
    error = np.where(both, np.abs(there.t - seen.t) / (ROUNDING * scale), 0)
    i = int((bad if bad.any() else error).argmax())
    what = f"share of rays answered otherwise in {other}"
    law.at_most(what, bad.mean(), 2e-3, "outlines hang on roundings", case.snippet(o[i], d[i]))
    what = f"distance in {other}, off by roundings of the largest number"
    why = "some dozen operations each, and another cosine with the surface"
    law.at_most(what, error.max(), 4 * HIT_ROUNDINGS, why, case.snippet(o[i], d[i]))


LAWS = {
    "hits": hits,
    "surface": surface,
    "normals": normals,
    "watertight": watertight,
    "scale": scale,
    "far": far,
    "finite": finite,
    "sampling": sampling,
    "bbox": bbox,
    "variants": variants,
}
