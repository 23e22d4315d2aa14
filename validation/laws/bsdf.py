"""``check_bsdf``: the laws that any BSDF must obey, stock or in Python, reflecting or transmitting.

A law is a function under ``@figures`` in one of the modules of ``LAWS``; ``law.py`` says what belongs to it.
"""

from __future__ import annotations

from collections.abc import Iterable

from mrt_mitsuba.validation.laws import bsdf_components, bsdf_gradients, bsdf_samples, bsdf_values
from mrt_mitsuba.validation.laws.bsdf_case import Case
from mrt_mitsuba.validation.laws.examine import TIMEOUT, Check, examine
from mrt_mitsuba.validation.laws.law import laws_in
from mrt_mitsuba.validation.laws.subject import Given

LAWS = laws_in(bsdf_samples, bsdf_values, bsdf_gradients, bsdf_components)


def check_bsdf(
    bsdf: Given,
    *,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
    timeout: float = TIMEOUT,
) -> Check:
    """Check the laws of a BSDF in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    ``quick``: fewer angles and samples. ``only``: names of ``LAWS``. ``timeout``: seconds after which a law
    fails that is not done. A loaded BSDF skips what has to load it again. Raises ``UsageError`` for anything
    else, and ``SceneError`` for a dict that Mitsuba cannot load.
    """
    return examine(Case, bsdf, LAWS, quick=quick, seed=seed, only=only, timeout=timeout)
