"""The layers of a picture, one row each: read by the plan, the tracer, the files and the help.

A new layer takes one row and, unless it is derived, a property of ``rendering.shading.RayValues``.
"""

from __future__ import annotations

from collections import namedtuple

FIRST_HIT = "first hit"  # of the first ray of a pixel; a mean would name no point
AVERAGED = "averaged"  # over the rays of a pixel, as the picture is
DERIVED = "derived"  # by a pass over the picture


Layer = namedtuple("Layer", "name letters source doc counts internal", defaults=("", False))
Layer.__doc__ = """A row of the table.

``letters`` name its EXR channels, in the order of the last axis. ``source``: ``FIRST_HIT``, ``AVERAGED`` or
``DERIVED``. ``doc``: for the page of the command. ``counts``: the kind of rays that it counts. ``internal``:
it cannot be asked for.
"""

_ROWS = (
    Layer("depth", "Z", FIRST_HIT, "distance of the hit"),
    Layer("normal", "XYZ", FIRST_HIT, "geometric normal"),
    Layer("albedo", "RGB", FIRST_HIT, "diffuse reflectance"),
    Layer("edges", "Y", DERIVED, "what the edge detector measured"),
    Layer("samples", "Y", DERIVED, "samples of the pixel"),
    Layer("error", "Y", DERIVED, "standard error of the pixel"),
    Layer("variance", "RGB", DERIVED, "variance of the pixel"),
    Layer("noisy", "RGB", DERIVED, "picture before denoising"),
    Layer("denoised", "Y", DERIVED, "weight of the denoised picture"),
    Layer("blur", "Y", DERIVED, "amount of blur in pixels"),
    Layer("image", "RGB", AVERAGED, "the picture", internal=True),
    Layer("direct", "RGB", AVERAGED, "radiance without specular reflections"),
    Layer("reflection", "RGB", AVERAGED, "radiance that specular reflections add"),
    Layer("bounces", "Y", AVERAGED, "number of specular reflections", counts="mirror"),
    Layer("shadow_rays", "Y", AVERAGED, "", counts="shadow", internal=True),
    Layer("square", "RGB", AVERAGED, "square of the picture", internal=True),
)

TABLE = {layer.name: layer for layer in _ROWS}
#: The layers that can be asked for, by name
LAYERS = {name: layer for name, layer in TABLE.items() if not layer.internal}
