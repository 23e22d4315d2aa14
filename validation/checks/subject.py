"""A plugin under examination: loaded, loaded again in other variants, and as a program in plain Mitsuba.

A law's ``snippet`` is such a program with the numbers of its worst case. Each law has the body next to it;
``_SETUP`` comes before it, for the names that are known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from textwrap import indent
from typing import Any, TypeVar

import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.scene.loading import load_dict
from mrt_mitsuba.validation.checks.law import Skip
from mrt_mitsuba.validation.checks.probe import Array, is_scalar, unit

Found = TypeVar("Found")
SCALAR_SHARE = 1 / 64  # of the lanes that a vectorised variant gets: others call once for each


@dataclass(frozen=True)
class Kept:
    """A tensor or transform of a dict: loading uses up the one, and the other's type is the variant's."""

    kind: str  # what makes it: "TensorXf" or "ScalarTransform4f"
    values: np.ndarray


class Subject:
    """A plugin under examination, given by its dict or loaded, and how thorough to be."""

    word = "plugin"  # what snippets call it

    def __init__(self, given: Any, quick: bool, seed: int) -> None:
        self.quick, self.seed, self.rng = quick, seed, np.random.default_rng(seed)
        self.description: dict[str, Any] | None = None  # None where a loaded object was given
        if isinstance(given, dict):
            self.description = _kept(given)
            self.name = str(given.get("type", "dict"))
            self.plugin = load_dict(_made(self.description), f"the {self.name}")
        else:
            self.name, self.plugin = class_name(given), given

    def with_(self, **changes: Any) -> dict[str, Any]:
        """Return the dict with other values of some parameters. Raises ``Skip`` without one."""
        if self.description is None:
            raise Skip("a loaded object was given: this needs the dict that it is made from")
        return {**self.description, **_kept(changes)}

    def load(self, **changes: Any) -> Any:
        """Load it in the current variant, with other values of some parameters. Raises ``Skip`` as well."""
        return mi.load_dict(_made(self.with_(**changes)))

    def scene(self, **changes: Any) -> Any:
        """Load a scene that holds the shape alone, or an instance with its group. Raises ``Skip`` as well."""
        given = self.with_(**changes)
        nodes: dict[str, Any] = {"shape": given}
        for key, value in given.items():
            if given["type"] == "instance" and isinstance(value, dict) and value["type"] == "shapegroup":
                nodes = {"group": value, "shape": {**given, key: {"type": "ref", "id": "group"}}}
        return mi.load_dict({"type": "scene", **_made(nodes)})

    def units(self, count: int) -> Array:
        """Return directions over the whole sphere."""
        return unit(self.rng.normal(size=(count, 3)))

    def uniform(self, *size: int) -> Array:
        return self.rng.random(size, np.float32)

    def count(self, quick: int, full: int) -> int:
        """Return how many lanes to use."""
        number = quick if self.quick else full
        return max(int(number * SCALAR_SHARE), 64) if is_scalar() else number

    def program(self, body: str, **names: Any) -> str:
        """Return a program that loads the plugin and runs ``body``, filled with ``names``."""
        text = "".join(setup for name, setup in _SETUP.items() if names.get(name) is not None) + "\n" + body
        variant = mi.variant()
        if "PCG32(n)" in text:
            variant = variant.replace("scalar_", "llvm_ad_")
        given = None if self.description is None else _source(self.description)
        ours = "'mrt_" in (given or "")
        known = ours or type(self.plugin).__module__.startswith("mitsuba")
        load = f"# {self.word}: the object that was checked\nload = lambda: {self.word}\n"
        if given is not None:
            load = "mrt.register()\n" if ours else "" if known else f"# register {self.name!r} here\n"
            load += f"\ndef load(**more):\n    return mi.load_dict({{**{given}, **more}})\n"
            load += f"\n{self.word} = load()\n"
        start = "import mrt_mitsuba as mrt  # before mitsuba\n" if ours else ""
        start += (
            f"import drjit as dr\nimport mitsuba as mi\nimport numpy as np\n\nmi.set_variant({variant!r})\n"
        )
        return start + load + text.format(variant=variant, **{k: _written(v) for k, v in names.items()})


def class_name(plugin: Any) -> str:
    """Return the name of a plugin's class: Mitsuba calls all those in Python by that of their base."""
    python = type(plugin).__module__.split(".")[0] != "mitsuba"
    return type(plugin).__name__ if python or not hasattr(plugin, "class_name") else plugin.class_name()


def other_kind() -> str:
    """Return the scalar variant of a vectorised one, or the other way around."""
    here = mi.variant()
    return here.replace("scalar_", "llvm_ad_") if is_scalar() else f"scalar_{here.split('_', 2)[-1]}"


def elsewhere(other: str, call: Callable[[], Found]) -> Found:
    """Return what a function gives in another variant. Raises ``Skip`` where variant or plugin is missing."""
    if other not in mi.variants() or runtime.obstacle(other):
        raise Skip(f"{other} cannot run here")
    here = mi.variant()
    try:
        runtime.use(other)
        return call()
    except RuntimeError as problem:
        if "not found" not in str(problem):
            raise
        register = "register it there (mi.detail.add_variant_callback)"
        raise Skip(f"{other} does not know the plugin: {register}") from problem
    finally:
        mi.set_variant(here)


def reason(problem: Exception) -> str:
    """Return the last line of an error of Mitsuba's, which is what happened."""
    return str(problem).strip().splitlines()[-1][:200]


def _kept(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _kept(entry) for key, entry in value.items()}
    if hasattr(value, "matrix") and hasattr(value, "inverse_transpose"):
        return Kept("ScalarTransform4f", np.array(value.matrix, np.float64))
    return Kept("TensorXf", np.array(value)) if type(value).__name__.startswith("TensorX") else value


def _made(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _made(entry) for key, entry in value.items()}
    return getattr(mi, value.kind)(value.values) if isinstance(value, Kept) else value


def _source(value: Any) -> str | None:
    """Return a kept dict's value as Python; None where it holds what has no source."""
    if isinstance(value, (dict, list, tuple)):
        entries = value.values() if isinstance(value, dict) else value
        parts = [_source(entry) for entry in entries]
        if None in parts:
            return None
        if isinstance(value, dict):
            return f"{{{', '.join(f'{key!r}: {part}' for key, part in zip(value, parts, strict=True))}}}"
        return f"[{', '.join(map(str, parts))}]"
    if isinstance(value, Kept):
        array = f"np.array({value.values.tolist()}, np.float32)"
        return f"mi.{value.kind}({array})" if value.values.size <= 64 else None
    return repr(value) if isinstance(value, (bool, int, float, str)) else None


def _written(value: Any) -> str:
    """Return a value as Python text; float32 in the fewest digits that give it back."""
    if isinstance(value, np.ndarray):
        inner = ", ".join(str(x) for x in value.astype(np.float32))
        return inner if value.dtype == np.float32 and len(value) in (2, 3) else f"[{inner}]"
    return value if isinstance(value, str) else repr(value.item() if isinstance(value, np.generic) else value)


_SETUP = {
    "wi": """
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
    "setting": """
key, number = {setting}
params = mi.traverse(bsdf)
params[key] = type(params[key])(params[key] * 0 + number)
params.update()
""",
    "component": "ctx.component = {component}\n",
    "wo": "wo = mi.Vector3f({wo})\ndr.make_opaque(wo)\n",
    "u": "u = {u}\nbs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))\n",
    "o": """
scene = mi.load_dict({{"type": "scene", "shape": shape}})
o, d = mi.Point3f({o}), mi.Vector3f({d})
dr.make_opaque(o, d)
""",
}
VALUES = "for variant in {variants}:\n    mi.set_variant(variant)\n    bsdf = load()\n" + indent(
    _SETUP["wi"] + _SETUP["wo"] + "print(variant, bsdf.eval(ctx, si, wo), bsdf.pdf(ctx, si, wo))\n", "    "
)  # in several variants
