"""``check_shape``: the laws that any shape must obey, stock, mesh or in Python.

A new law is a function of ``Law`` and ``Case`` in a module next to this one, and a row of ``LAWS``; see
``bsdf``.
"""

from __future__ import annotations

from collections.abc import Iterable

from mrt_mitsuba.validation.checks.law import TIMEOUT, Check, Given, examine
from mrt_mitsuba.validation.checks.shape_case import Case
from mrt_mitsuba.validation.checks.shape_hits import (
    bbox,
    far,
    finite,
    hits,
    normals,
    scale,
    surface,
    variants,
    watertight,
)
from mrt_mitsuba.validation.checks.shape_samples import sampling

_ALL = (hits, surface, normals, watertight, scale, far, finite, sampling, bbox, variants)
LAWS = {law.__name__: law for law in _ALL}


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
