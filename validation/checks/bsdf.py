"""``check_bsdf``: the laws that any BSDF must obey, stock or in Python, reflecting or transmitting.

A new law is a function of ``Law`` and ``Case`` in a module next to this one, and a row of ``LAWS``. Its
docstring states it; ``figures`` are what it measures, each with its statistic, limit, reason, and the snippet
that shows the worst case.
"""

from __future__ import annotations

from collections.abc import Iterable

from mrt_mitsuba.validation.checks.bsdf_case import Case
from mrt_mitsuba.validation.checks.bsdf_components import components, switch, variants
from mrt_mitsuba.validation.checks.bsdf_gradients import gradients
from mrt_mitsuba.validation.checks.bsdf_samples import energy, sampling, weights
from mrt_mitsuba.validation.checks.bsdf_values import eval_pdf, finite, reciprocity, roundoff
from mrt_mitsuba.validation.checks.law import TIMEOUT, Check, Given, examine

_ALL = (
    sampling,
    weights,
    eval_pdf,
    energy,
    reciprocity,
    finite,
    roundoff,
    gradients,
    components,
    variants,
    switch,
)
LAWS = {law.__name__: law for law in _ALL}


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
