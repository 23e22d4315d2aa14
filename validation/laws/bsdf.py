"""``check_bsdf``: the laws that any BSDF must obey, stock or in Python, reflecting or transmitting.

A law is a function under ``@measures``, named in ``LAWS``; ``law.py`` says what belongs to it.
"""

from __future__ import annotations

from collections.abc import Iterable

from . import bsdf_components, bsdf_gradients, bsdf_samples, bsdf_values
from .bsdf_case import BsdfCase
from .case import Given
from .examine import examine
from .law import by_name
from .page import Check

LAWS = by_name(
    bsdf_samples.sampling,
    bsdf_samples.weights,
    bsdf_samples.energy,
    bsdf_values.eval_pdf,
    bsdf_values.reciprocity,
    bsdf_values.finite,
    bsdf_values.roundoff,
    bsdf_gradients.gradients,
    bsdf_components.components,
    bsdf_components.null_transmission,
    bsdf_components.variants,
    bsdf_components.switch,
)


def check_bsdf(
    bsdf: Given,
    *,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
) -> Check:
    """Check the laws of a BSDF in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    ``quick``: fewer angles and samples. ``only``: names of ``LAWS``. A loaded BSDF skips what has to load it
    again. Raises ``UsageError`` for anything else, and ``LoadError`` for a dict that Mitsuba cannot load.
    """
    return examine(BsdfCase, bsdf, LAWS, quick=quick, seed=seed, only=only)
