"""Worst cases as programs in plain Mitsuba: what a law's ``snippet`` is made of.

The first line of a program names what of ``_SETUP`` comes before it.
"""

from __future__ import annotations

from textwrap import indent
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.checks.recipe import source

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

SAMPLING = """point draw
r0, r1, phi0, phi1, side = {cell}  # a cell: sqrt(1 - |cos|) and azimuth from ... to, and which hemisphere
r, phi = dr.sqrt((bs.wo.x**2 + bs.wo.y**2) / (1 + dr.abs(bs.wo.z))), dr.atan2(bs.wo.y, bs.wo.x)
inside = (r >= r0) & (r < r1) & (phi >= phi0) & (phi < phi1) & (bs.wo.z * side > 0)
inside &= (bsdf.pdf(ctx, si, bs.wo) > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
r, phi = r0 + (r1 - r0) * rng.next_float32(), phi0 + (phi1 - phi0) * rng.next_float32()
sin = r * dr.sqrt(2 - r * r)
wo = mi.Vector3f(sin * dr.cos(phi), sin * dr.sin(phi), side * (1 - r * r))
density = dr.mean(bsdf.pdf(ctx, si, wo) * 2 * r)[0] * (r1 - r0) * (phi1 - phi0)
print("share of samples in the cell:", dr.count(inside)[0] / n, "pdf() says:", density)
"""
NORMALISED = """point draw
smooth = (bsdf.pdf(ctx, si, bs.wo) > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
print("share of samples that pdf() stands for:", dr.count(smooth)[0] / n)
wo = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
print("integral of pdf() by uniform directions:", dr.mean(bsdf.pdf(ctx, si, wo))[0] * 4 * dr.pi)
"""
WEIGHT = """point sample
pdf = bsdf.pdf(ctx, si, bs.wo)
print("a sample of density", bs.pdf, "weight", weight, "and index of refraction", bs.eta)
print("there, pdf():", pdf, "eval() / pdf():", bsdf.eval(ctx, si, bs.wo) / pdf)
"""
DISCRETE = """point draw
component, stated = np.array(bs.sampled_component), np.array(bs.pdf)
delta = np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
for i in np.unique(component[delta]):
    here = delta & (component == i)
    print("component", i, "states a probability of", stated[here].mean(), "and its share is", here.mean())
"""
PAIR = """point wo
print("eval_pdf():", bsdf.eval_pdf(ctx, si, wo))
print("eval():", bsdf.eval(ctx, si, wo), "pdf():", bsdf.pdf(ctx, si, wo))
"""
INACTIVE = """point wo
print("a lane switched off:", bsdf.eval(ctx, si, wo, False), "should be 0")
"""
ALBEDO = """point importance draw
print("albedo by samples:", dr.mean(weight, axis=1))
smooth = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), 0, weight)
print("without lobes of one direction:", dr.mean(smooth, axis=1))
wo = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
print("these by uniform directions:", dr.mean(bsdf.eval(ctx, si, wo), axis=1) * 4 * dr.pi)
"""
RECIPROCITY = """point wo
eta = {eta}  # index of refraction at wo over that at wi
forth = bsdf.eval(ctx, si, wo) / dr.abs(wo.z) * eta**2
si.wi, wo = wo, si.wi
back = bsdf.eval(ctx, si, wo) / dr.abs(wo.z)
print(forth, "should be", back)
"""
DELTA_RECIPROCITY = """point
# the way back should lead to where it came from, with the same product
for u in (({u}), ({back})):
    bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
    print(si.wi, "->", bs.wo, "probability x weight x eta^2:", bs.pdf * weight * bs.eta**2)
    si.wi = bs.wo
"""
FINITE = """point wo setting
print("eval():", bsdf.eval(ctx, si, wo), "pdf():", bsdf.pdf(ctx, si, wo))
"""
FINITE_SAMPLE = """point setting sample
print("weight:", weight, "density:", bs.pdf, "direction:", bs.wo)
"""
NOISE = """point wo
for k in range(9):  # float32 steps in all components: a smooth function would change evenly
    x = (np.array([{wo}], np.float32).view(np.int32) + {stride} * k).view(np.float32)
    print(np.ravel(bsdf.{function}(ctx, si, mi.Vector3f(*map(float, x)))))
"""
GRADIENT = """point wo
params, key = mi.traverse(bsdf), {key!r}
before = type(params[key])(params[key])

def value(shift):
    params[key] = type(before)(before + shift)
    params.update()
    return dr.sum(bsdf.eval(ctx, si, wo), axis=None)

shift = mi.Float(0)
dr.enable_grad(shift)
found = value(shift)
if dr.grad_enabled(found):
    dr.forward(shift)
print("derivative:", dr.grad(found), "difference:", (value(1e-3) - value(-1e-3)) / 2e-3)
"""
UPDATE = """point wo
params, key = mi.traverse(bsdf), {key!r}
print("eval():", bsdf.eval(ctx, si, wo))
params[key] = type(params[key])(params[key] * 0 + {number})
params.update()
print("after an update to {number}:", bsdf.eval(ctx, si, wo), "should be", {value})
"""
FLAGS = """
print("flags of the components:", [hex(int(bsdf.flags(i))) for i in range(bsdf.component_count())])
print("flags of the whole:", hex(int(bsdf.flags())))
"""
UPDATED = """
params = mi.traverse(bsdf)
print("components before:", bsdf.component_count())
for key in {keys}:
    params[key] = 0.9 * params[key]
params.update()
print("and after params.update():", bsdf.component_count())
"""
PARTS = """point wo
print("whole:", bsdf.eval(ctx, si, wo))
for i in range(bsdf.component_count()):
    ctx.component = i
    print("component", i, bsdf.eval(ctx, si, wo))
"""
SIDE = """point wo component
print("value:", bsdf.eval(ctx, si, wo), "flags:", hex(int(bsdf.flags(ctx.component))))
"""
COMPONENT_SAMPLE = """point component sample
print("flags:", hex(int(bsdf.flags(ctx.component))))
print("sample:", bs, "weight:", weight)
"""
_LOOP = """:
    mi.set_variant(variant)
    bsdf = load()
""" + indent(
    _SETUP["point"] + _SETUP["wo"] + "print(variant, bsdf.eval(ctx, si, wo), bsdf.pdf(ctx, si, wo))\n", "    "
)
VARIANT = "\nfor variant in ({variant!r}, {other!r})" + _LOOP
SWITCH = "\nfor variant in ({variant!r}, {other!r}, {variant!r})" + _LOOP
RAY = """ray
print(scene.ray_intersect(mi.Ray3f(o, d)))
"""
BEHIND = """ray
si = scene.ray_intersect(mi.Ray3f(o, d))
back = scene.ray_intersect(mi.Ray3f(si.spawn_ray(d).o, -d))
print("from the front:", si.n, "and from just behind:", back.n, "at", back.t)
"""
TWICE = """ray
for o in (o, mi.Point3f({other})):
    dr.make_opaque(o)
    print("from", o, "it is met at", scene.ray_intersect(mi.Ray3f(o, d)).p)
"""
MAXT = """ray
ray = mi.Ray3f(o, d)
print("meets the surface at", scene.ray_intersect(ray).t)
ray.maxt = float("{maxt}")
print("up to", ray.maxt, "ray_test():", scene.ray_test(ray), "ray_intersect():", scene.ray_intersect(ray).t)
"""
NEIGHBOUR = """ray
aside = mi.Vector3f({aside})
si = scene.ray_intersect(mi.Ray3f(o, d))
near = scene.ray_intersect(mi.Ray3f(o + 1e-3 * {size} * aside, d))
step, uv = near.p - si.p, near.uv - si.uv
print("slope against the normal:", dr.dot(step, si.n) / dr.norm(step))
print("step", step, "by partial derivatives:", si.dp_du * uv.x + si.dp_dv * uv.y)
"""
SCALED = """ray
print("as it is, t:", scene.ray_intersect(mi.Ray3f(o, d)).t)
scene = mi.load_dict({{"type": "scene", "shape": load(2.0**{power})}})
print("scaled, t over the scale:", scene.ray_intersect(mi.Ray3f(o * 2.0**{power}, d)).t / 2.0**{power})
"""
POSITIONS = """
n = 100_000
rng = mi.PCG32(n)
ps = shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32()))
print("mean of 1 / density:", dr.mean(1 / ps.pdf), "surface_area():", shape.surface_area())
ratio = shape.pdf_position(ps) / ps.pdf
print("pdf_position() / density:", dr.min(ratio), "...", dr.max(ratio))
"""


def program(name: str, loaded: Any, description: dict[str, Any] | None, body: str, **names: Any) -> str:
    """Return a program that loads a plugin under ``name``, a "bsdf" or a "shape", and runs ``body``."""
    variant = mi.variant()
    setup, _, rest = body.partition("\n")
    text = "".join(_SETUP[word] for word in setup.split()) + "\n" + rest
    if "PCG32(n)" in text:
        variant = variant.replace("scalar_", "llvm_ad_")
    shown = {key: value if isinstance(value, str) else _literal(value) for key, value in names.items()}
    return _head(name, loaded, description, variant) + text.format(variant=variant, **shown)


def _head(name: str, loaded: Any, description: dict[str, Any] | None, variant: str) -> str:
    """Return the lines that load a plugin under ``name``, with what it takes to know it."""
    text = source(description) if description is not None else None
    ours = text is not None and "'mrt_" in text
    lines = ["import mrt_mitsuba as mrt  # before mitsuba"] if ours else []
    lines += [f"import {module}" for module in ("drjit as dr", "mitsuba as mi", "numpy as np")]
    lines += ["", f"mi.set_variant({variant!r})", *(["mrt.register()"] if ours else [])]
    if description is None or text is None:
        return "\n".join([*lines, f"# {name}: the object that was checked", f"load = lambda: {name}", ""])
    if "python" in str(type(loaded).__mro__[0]) or not type(loaded).__module__.startswith("mitsuba"):
        lines += [] if ours else [f"# register {description['type']!r} here"]
    if name == "shape":  # which a snippet may want in another size
        scaled = "mi.ScalarTransform4f().scale(scale) @ given.get('to_world', mi.ScalarTransform4f())"
        body = ["def load(scale=None):", f"    given = {text}"]
        body += ["    if scale:", f"        given['to_world'] = {scaled}", "    return mi.load_dict(given)"]
    else:
        body = ["def load():", f"    return mi.load_dict({text})"]
    return "\n".join([*lines, "", *body, "", f"{name} = load()", ""])


def _literal(value: Any) -> str:
    """Return float32 numbers in the fewest digits that give them back; a vector without brackets."""
    if isinstance(value, np.ndarray):
        inner = ", ".join(str(x) for x in value.astype(np.float32))
        return f"[{inner}]" if value.dtype != np.float32 or len(value) not in (2, 3) else inner
    return repr(value.item() if isinstance(value, np.generic) else value)
