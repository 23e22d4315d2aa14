"""``check_shape``: the laws that any shape must obey, stock, mesh or in Python; see ``bsdf``."""

from __future__ import annotations

from collections.abc import Iterable

from . import shape_hits, shape_samples
from .case import Given
from .examine import examine
from .law import by_name
from .page import Check
from .shape_case import ShapeCase

LAWS = by_name(
    shape_hits.hits,
    shape_hits.surface,
    shape_hits.normals,
    shape_hits.watertight,
    shape_hits.scale,
    shape_hits.far,
    shape_hits.finite,
    shape_hits.bbox,
    shape_hits.variants,
    shape_samples.sampling,
)


def check_shape(
    shape: Given,
    *,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
) -> Check:
    """Check the laws of a shape in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    Any other object that has ``ray_intersect``, ``ray_test`` and ``bbox`` will do as well.
    ``quick``: fewer rays. ``only``: names of ``LAWS``. Raises ``UsageError`` for anything else, and
    ``LoadError`` for a dict that Mitsuba cannot load.
    """
    return examine(ShapeCase, shape, LAWS, quick=quick, seed=seed, only=only)
