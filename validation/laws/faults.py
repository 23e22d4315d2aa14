"""Changes that make faults of several laws: functions of a size, of an answer, and of what was asked.

They are for ``finds``. Without types: those of Mitsuba depend on the variant.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

GLASS = {"type": "dielectric"}
GLOSS = {"type": "roughconductor", "alpha": 0.2}
VEIL = {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse"}}
SIZE = 2 * 3**0.5  # of the cube: its diagonal
DEGREE = 0.01745
PLACE = (0.48, 0.36, 0.8)  # a direction away from all axes


def put(record, **members):
    """A hit or a sample with other values of some members."""
    for name, value in members.items():
        setattr(record, name, value)
    return record


def larger(size, value, *_):
    return (1 + size) * value


def larger_by(part):
    """Make a change of a function of what was asked: values grow by the size times its result."""

    def apply(size, value, *asked):
        return (1 + size * part(*asked)) * value

    return apply


def smaller(size, value, *_):
    return value / (1 + size)


def member(name, change):
    """A change of a member of a record; what comes with the record stays."""

    def apply(size, record, *given):
        return put(record, **{name: change(size, getattr(record, name))})

    return apply


def of_sample(change):
    """A change of records as one of the samples of a BSDF, whose weight stays."""

    def apply(size, bs, weight, *_):
        return change(size, bs), weight

    return apply


def of_weight(change):
    """A change of the weights of samples of a BSDF, by their random numbers."""

    def apply(size, bs, weight, u, _):
        return bs, change(size, weight, u)

    return apply


def no_number(size, weight, u, *_):
    """NaN for a share of the random numbers."""
    return dr.select((u.x > 0.3) & (u.x < 0.3 + size), dr.nan, weight)


def tilted(size, n):
    """Normals tilted by an angle."""
    return dr.normalize(n + size * mi.Normal3f(0.6, 0.48, 0.64))


def off_surface(size, record, *_):
    return put(record, p=record.p + SIZE * size * record.n)
