"""The layers of a picture, one row each: read by the plan, the tracer, the files and the help.

A new layer takes one row. What its ``value`` is computed from along camera rays, see ``rendering.shading``.
"""

from __future__ import annotations

import math
from collections import namedtuple

FIRST_HIT = "first hit"  # of the first ray of a pixel; a mean would name no point
AVERAGED = "averaged"  # over the rays of a pixel, as the picture is
DERIVED = "derived"  # by a pass over the picture


Layer = namedtuple("Layer", "name letters source doc value counts internal", defaults=(None, "", False))
Layer.__doc__ = """A row of the table.

``letters`` name its EXR channels, in the order of the last axis. ``source``: ``FIRST_HIT``, ``AVERAGED`` or
``DERIVED``. ``doc``: for the page of the command. ``value``: a function of what is known along rays; None for
a derived layer. ``counts``: the kind of rays that it counts. ``internal``: it cannot be asked for.
"""

_FIRST_HITS = (
    Layer(
        "depth",
        "Z",
        FIRST_HIT,
        "distance of the hit",
        lambda r: r.at_hit("Float", r.distance, math.inf),
    ),
    Layer("normal", "XYZ", FIRST_HIT, "geometric normal", lambda r: r.at_hit("Vector3f", r.si.n)),
    Layer("albedo", "RGB", FIRST_HIT, "diffuse reflectance", lambda r: r.albedo),
)
_DERIVED = (
    Layer("edges", "Y", DERIVED, "what the edge detector measured"),
    Layer("samples", "Y", DERIVED, "samples of the pixel"),
    Layer("error", "Y", DERIVED, "standard error of the pixel"),
    Layer("variance", "RGB", DERIVED, "variance of the pixel"),
    Layer("noisy", "RGB", DERIVED, "picture before denoising"),
    Layer("denoised", "Y", DERIVED, "weight of the denoised picture"),
    Layer("blur", "Y", DERIVED, "amount of blur in pixels"),
)
_AVERAGED = (
    Layer("image", "RGB", AVERAGED, "the picture", lambda r: r.image, internal=True),
    Layer(
        "direct", "RGB", AVERAGED, "radiance without specular reflections", lambda r: r.rgb(r.trace.direct)
    ),
    Layer(
        "reflection",
        "RGB",
        AVERAGED,
        "radiance that specular reflections add",
        lambda r: r.rgb(r.trace.radiance - r.trace.direct),
    ),
    Layer(
        "bounces", "Y", AVERAGED, "number of specular reflections", lambda r: r.trace.bounces, counts="mirror"
    ),
    Layer("shadow_rays", "Y", AVERAGED, "", lambda r: r.trace.shadow_rays, counts="shadow", internal=True),
    Layer("square", "RGB", AVERAGED, "square of the picture", lambda r: r.image * r.image, internal=True),
)

TABLE = {layer.name: layer for layer in (*_FIRST_HITS, *_DERIVED, *_AVERAGED)}
#: The layers that can be asked for, by name
LAYERS = {name: layer for name, layer in TABLE.items() if not layer.internal}
