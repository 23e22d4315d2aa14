"""A plugin under examination: how it is loaded, in any variant, and the programs that show its faults."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from textwrap import indent
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.scene.loading import load_dict
from mrt_mitsuba.validation.laws.law import Description, Found, Law, Skip
from mrt_mitsuba.validation.laws.probe import Array, Lanes, is_scalar, unit

Given = Any  # such a dict, a value of one, or a loaded plugin
SCALAR_SHARE = 1 / 64  # of the lanes that a vectorised variant gets: others call once for each


@dataclass(frozen=True, repr=False)
class Kept:
    """A tensor or transform of a dict: loading uses up the one, and the other's type is the variant's."""

    kind: str  # what makes it: "TensorXf" or "ScalarTransform4f"
    values: np.ndarray

    def __repr__(self) -> str:
        """Its source in Python, if it is small."""
        array = f"np.array({self.values.tolist()}, np.float32)"
        return f"mi.{self.kind}({array})" if self.values.size <= 64 else "<many numbers>"


class Subject:
    """A plugin under examination, given by its dict or loaded, and how thorough to be."""

    word = "plugin"  # what snippets call it

    def __init__(self, given: Given, quick: bool, seed: int) -> None:
        self.quick = quick
        self.seed = seed
        self.rng = np.random.default_rng(seed)
        self.description: Description | None = None  # None where a loaded object was given
        if isinstance(given, dict):
            self.description = _kept(given)
            self.name = str(given.get("type", "dict"))
            self.plugin: mi.Object = load_dict(_made(self.description), f"the {self.name}")
        else:
            self.name = class_name(given)
            self.plugin = given
        # what Mitsuba itself says against it
        self.unsupported = _refused(self.plugin) if isinstance(self.plugin, mi.Shape) else ""

    def with_(self, **changes: Any) -> Description:
        """The dict with other values of some parameters. Raises ``Skip`` without one."""
        if self.description is None:
            raise Skip("a loaded object was given: this needs the dict that it is made from")
        return {**self.description, **_kept(changes)}

    def load(self, **changes: Any) -> mi.Object:
        """Load it in the current variant, with other values of some parameters. Raises ``Skip`` as well."""
        return mi.load_dict(_made(self.with_(**changes)))

    def scene(self, **changes: Any) -> mi.Scene:
        """Load a scene that holds the shape alone, or an instance with its group. Raises ``Skip`` as well."""
        given = self.with_(**changes)
        nodes = {"shape": given}
        for key, value in given.items():
            if given["type"] == "instance" and isinstance(value, dict) and value["type"] == "shapegroup":
                nodes = {"group": value, "shape": {**given, key: {"type": "ref", "id": "group"}}}
        return mi.load_dict({"type": "scene", **_made(nodes)})

    def units(self, count: int) -> Array:
        """Random directions [count, 3], uniform over the sphere."""
        return unit(self.rng.normal(size=(count, 3)))

    def uniform(self, *size: int) -> Array:
        return self.rng.random(size, np.float32)

    def count(self, quick: int, full: int) -> int:
        """How many lanes to use."""
        number = quick if self.quick else full
        return max(int(number * SCALAR_SHARE), 64) if is_scalar() else number

    def few(self, lanes: Lanes, quick: int, full: int) -> Lanes:
        """The first lanes, so many."""
        return lanes[: self.count(quick, full)]

    def program(self, body: str, **names: Any) -> str:
        """A program that loads the plugin and runs ``body``, filled with ``names``."""
        setups = [setup for name, setup in _SETUP.items() if names.get(name) is not None]
        text = "".join(setups) + "\n" + body
        if "variants" in names:
            text = f"mi.set_variant(variant)\nprint(variant)\n{self.word} = load()\n{text}"
            text = "for variant in {variants}:\n" + indent(text, "    ")
        kind = "llvm_ad_" if "PCG32(n)" in text else "scalar_"
        variant = mi.variant().replace("scalar_", kind)
        ours = "'mrt_" in repr(self.description)
        start = "import drjit as dr\nimport mitsuba as mi\nimport numpy as np\n\n"
        start += f"mi.set_variant({variant!r})\n"
        if ours:
            start = f"import mrt_mitsuba as mrt  # before mitsuba\n{start}mrt.register()\n"
        values = {name: _written(value) for name, value in names.items()}
        return start + self._loading(ours) + text.format(**values)

    def _loading(self, ours: bool) -> str:
        """The part of a program that defines ``load`` and loads the plugin."""
        source = repr(self.description)
        with suppress(Exception):  # some dicts hold objects without a source text
            if eval(source, {"mi": mi, "np": np}):
                stock = type(self.plugin).__module__.startswith("mitsuba")
                reminder = "" if ours or stock else f"# register {self.name!r} here\n"
                loading = f"mi.load_dict({{**{source}, **more}})"
                return f"{reminder}\ndef load(**more):\n    return {loading}\n\n{self.word} = load()\n"
        return f"# {self.word}: the object that was checked\nload = lambda: {self.word}\n"

    def elsewhere(self, other: str, call: Callable[[], Found]) -> Found:
        """Call a function in another variant. Raises ``Skip`` where that cannot run."""
        if other not in mi.variants() or runtime.obstacle(other):
            raise Skip(f"{other} cannot run here")
        here = mi.variant()
        try:
            runtime.use(other)
            return call()
        except RuntimeError as problem:
            if "not found" not in str(problem):
                raise
            fix = "register it there (mi.detail.add_variant_callback)"
            raise Skip(f"{other} does not know the plugin: {fix}") from None
        finally:
            runtime.use(here)

    @property
    def other_kind(self) -> str:
        """The scalar variant of a vectorised one, or the other way around."""
        here = mi.variant()
        return here.replace("scalar_", "llvm_ad_") if is_scalar() else f"scalar_{here.split('_', 2)[-1]}"


def judge_many(
    law: Law, case: Subject, call: Callable[[Callable[[], mi.Float]], tuple[mi.Mask, dict[str, mi.Point3f]]]
) -> None:
    """Hold ``million`` to so many lanes that a fault in one of a hundred thousand shows.

    ``call(draw)`` gives the lanes that are bad, and what else snippets show of the first of them, in terms of
    random numbers that ``draw()`` makes. Scalar variants are too slow for this.
    """
    if is_scalar():
        return
    count = case.count(2**20, 2**22)
    # random numbers of which each has one in every 1 / count: faults in any wider slice of one are met
    sampler = mi.load_dict({"type": "stratified", "sample_count": count})
    sampler.set_samples_per_wavefront(count)
    sampler.seed(case.seed + 1, count)  # 1 finds the least faults that the table of power states

    def draw() -> mi.Float:
        return dr.minimum(sampler.next_1d(), dr.one_minus_epsilon(mi.Float))

    with dr.suspend_grad():
        bad, columns = call(draw)
        dr.eval(bad, *columns.values())
        wrong = dr.compress(bad)
    index = wrong[0] if dr.width(wrong) else 0
    first = {name: np.float32(np.array(x)[:, index]) for name, x in columns.items()}
    law.hold("million", dr.width(wrong), count=count, **first)


def class_name(plugin: mi.Object) -> str:
    """Name of a plugin's class: Mitsuba calls all those in Python by that of their base."""
    python = type(plugin).__module__.split(".")[0] != "mitsuba"
    return type(plugin).__name__ if python or not hasattr(plugin, "class_name") else plugin.class_name()


def _refused(shape: mi.Shape) -> str:
    """What Mitsuba warns of in the transform of a stock shape, "" if nothing.

    A shape of the same kind is loaded while warnings are errors.
    """
    params = mi.traverse(shape)
    stock = type(shape).__module__.startswith("mitsuba")
    if not stock or "to_world" not in params:
        return ""
    matrix = np.array(params["to_world"].matrix, np.float64).reshape(4, 4)
    kind = class_name(shape).lower()
    logger = mi.logger()
    levels = logger.log_level(), logger.error_level()
    logger.set_log_level(mi.LogLevel.Warn)
    logger.set_error_level(mi.LogLevel.Warn)
    try:
        mi.load_dict({"type": kind, "to_world": mi.ScalarTransform4f(matrix)})
    except RuntimeError as problem:
        _, transform, words = str(problem).partition("'to_world' transform shouldn't")
        return f"Mitsuba does not support it: {transform}{words}" if words else ""
    finally:
        logger.set_log_level(levels[0])
        logger.set_error_level(levels[1])
    return ""


def _kept(value: Given) -> Given:
    if isinstance(value, dict):
        return {key: _kept(entry) for key, entry in value.items()}
    if hasattr(value, "matrix") and hasattr(value, "inverse_transpose"):
        return Kept("ScalarTransform4f", np.array(value.matrix, np.float64))
    return Kept("TensorXf", np.array(value)) if type(value).__name__.startswith("TensorX") else value


def _made(value: Given) -> Given:
    if isinstance(value, dict):
        return {key: _made(entry) for key, entry in value.items()}
    return getattr(mi, value.kind)(value.values) if isinstance(value, Kept) else value


def _written(value: object) -> str:
    """A value as Python text; float32 in the fewest digits that give it back."""
    if isinstance(value, np.ndarray):
        inner = ", ".join(str(x) for x in np.float32(value))
        vector = value.dtype == np.float32 and len(value) in (2, 3)
        return inner if vector else f"[{inner}]"
    if isinstance(value, np.generic):
        value = value.item()
    return value if isinstance(value, str) else repr(value)


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
