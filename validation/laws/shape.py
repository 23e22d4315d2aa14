"""``check_shape``: the laws that any shape must obey, stock, mesh or in Python; see ``bsdf``."""

from __future__ import annotations

from collections.abc import Iterable

from mrt_mitsuba.validation.laws import shape_hits, shape_samples
from mrt_mitsuba.validation.laws.examine import TIMEOUT, Check, examine
from mrt_mitsuba.validation.laws.law import laws_in
from mrt_mitsuba.validation.laws.shape_case import Case
from mrt_mitsuba.validation.laws.subject import Given

LAWS = laws_in(shape_hits, shape_samples)


def check_shape(
    shape: Given,
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
    return examine(Case, shape, LAWS, quick=quick, seed=seed, only=only, timeout=timeout)
