"""Worst cases as programs in plain Mitsuba: what a law's ``snippet`` is made of.

Each law has a text next to it, to be filled with the numbers of its worst case; its first line names what of
``_SETUP`` comes before it.
"""

from __future__ import annotations

from textwrap import indent
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.checks.recipe import Subject, source

_SETUP = {
    "point": """
si = dr.zeros(mi.SurfaceInteraction3f)
si.n, si.t, si.p = mi.Normal3f(0, 0, 1), 1, mi.Point3f(0, 0, 0)
si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
if mi.is_spectral:
    si.wavelengths = type(si.wavelengths)(450, 500, 550, 600)
si.uv = mi.Point2f({uv})
si.wi = mi.Vector3f({wi})
dr.make_opaque(si.wi)  # numbers, not parts of the program: they are computed with otherwise
ctx = mi.BSDFContext()
""",
    "wo": "wo = mi.Vector3f({wo})\ndr.make_opaque(wo)\n",
    "draw": """
n = 1_000_000
rng = mi.PCG32(n)
bs, weight = bsdf.sample(ctx, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
""",
    "sample": "u = {u}\nbs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))\n",
    "component": "ctx.component = {component}\n",
    "importance": "ctx = mi.BSDFContext(mi.TransportMode.Importance)\n",
    "setting": """
setting = {setting}  # a parameter and its value
if setting:
    params = mi.traverse(bsdf)
    key = setting[0]
    params[key] = type(params[key])(params[key] * 0 + setting[1])
    params.update()
""",
    "ray": """
scene = mi.load_dict({{"type": "scene", "shape": shape}})
o, d = mi.Point3f({o}), mi.Vector3f({d})
dr.make_opaque(o, d)
""",
}
_SETUP["each"] = "\nfor variant in {variants}:\n    mi.set_variant(variant)\n    bsdf = load()\n" + indent(
    _SETUP["point"] + _SETUP["wo"] + "print(variant, bsdf.eval(ctx, si, wo), bsdf.pdf(ctx, si, wo))\n", "    "
)


def _written(value: Any) -> str:
    """Return a value as Python text; float32 in the fewest digits that give it back."""
    if isinstance(value, np.ndarray):
        inner = ", ".join(str(x) for x in value.astype(np.float32))
        return inner if value.dtype == np.float32 and len(value) in (2, 3) else f"[{inner}]"
    return value if isinstance(value, str) else repr(value.item() if isinstance(value, np.generic) else value)


def program(name: str, subject: Subject, body: str, **names: Any) -> str:
    """Return a program that loads a plugin under ``name``, a "bsdf" or a "shape", and runs ``body``."""
    setup, _, rest = body.partition("\n")
    text = "".join(_SETUP[word] for word in setup.split()) + "\n" + rest
    variant = mi.variant()
    if "PCG32(n)" in text:
        variant = variant.replace("scalar_", "llvm_ad_")
    shown = {key: _written(value) for key, value in names.items()}
    given = source(subject.description) if subject.description is not None else None
    ours = given is not None and "'mrt_" in given
    lines = ["import mrt_mitsuba as mrt  # before mitsuba"] if ours else []
    lines += [f"import {module}" for module in ("drjit as dr", "mitsuba as mi", "numpy as np")]
    lines += ["", f"mi.set_variant({variant!r})", *(["mrt.register()"] if ours else [])]
    if given is None:
        lines += [f"# {name}: the object that was checked", f"load = lambda: {name}"]
    else:
        if not type(subject.plugin).__module__.startswith("mitsuba") and not ours:
            lines += [f"# register {subject.name!r} here"]
        if name == "shape":  # which a snippet may want in another size
            scaled = "mi.ScalarTransform4f().scale(scale) @ given.get('to_world', mi.ScalarTransform4f())"
            lines += ["", "def load(scale=None):", f"    given = {given}", "    if scale:"]
            lines += [f"        given['to_world'] = {scaled}", "    return mi.load_dict(given)"]
        else:
            lines += ["", "def load():", f"    return mi.load_dict({given})"]
        lines += ["", f"{name} = load()"]
    return "\n".join([*lines, ""]) + text.format(variant=variant, **shown)
