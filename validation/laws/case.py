"""A plugin under test: how it is loaded, in any variant, called, and shown to fail by a program."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import dataclass
from textwrap import indent
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from .law import LoadError, Outcome, Skip, UsageError
from .probe import Array, Lanes, is_scalar, unit

Description = dict[str, Any]  # of a plugin, as ``mi.load_dict`` takes it
Given = Any  # such a dict, a value of one, or a loaded plugin
Result = TypeVar("Result")
SCALAR_SHARE = 1 / 64  # of the lanes that a vectorised variant gets: others call once for each
ENDS = (0, 2.0**-24, 0.5, 1 - 2.0**-24)  # of random numbers, and the middle
WAVE = 2**20  # lanes that are checked at a time for results that are not finite
PREAMBLES: dict[str, str] = {}  # by package, what registers its plugins, before Mitsuba is imported


@dataclass(frozen=True, repr=False)
class Constant:
    """A tensor or transform of a dict: loading moves the one away, and the other's type is the variant's."""

    kind: str  # what makes it: "TensorXf" or "ScalarTransform4f"
    values: np.ndarray

    def __repr__(self) -> str:
        """Its source in Python, if it is small."""
        array = f"np.array({self.values.tolist()}, np.float32)"
        return f"mi.{self.kind}({array})" if self.values.size <= 64 else "<many numbers>"


class Case:
    """A plugin under test, given by its dict or loaded, and how thorough the test is."""

    word = "plugin"  # what snippets call it

    def __init__(self, given: Given, quick: bool, seed: int) -> None:
        self.quick = quick
        self.seed = seed
        self.rng = np.random.default_rng(seed)
        self.description: Description | None = None  # None where a loaded object was given
        if isinstance(given, dict):
            self.description = _kept(given)
            self.name = str(given.get("type", "dict"))
            try:
                self.plugin: mi.Object = mi.load_dict(_made(self.description))
            except (RuntimeError, TypeError, ValueError) as problem:
                raise LoadError(f"cannot load the {self.name}: {reason_of(problem)}") from problem
        else:
            self.name = class_name(given)
            self.plugin = given

    def need(self, kind: str, fits: bool) -> None:
        """Raise ``UsageError`` for a plugin that is of another kind."""
        if not fits:
            what = f"{type(self.plugin).__name__} is not {kind} of {mi.variant()}"
            raise UsageError(f"{what}: give a dict or a loaded one")

    def with_(self, **changes: object) -> Description:
        """The dict with other values of some parameters. Raises ``Skip`` without one."""
        if self.description is None:
            raise Skip("a loaded object was given: this needs the dict that it is made from")
        return {**self.description, **_kept(changes)}

    def load(self, **changes: object) -> mi.Object:
        """Load it in the current variant, with other values of some parameters. Raises ``Skip`` as well."""
        return mi.load_dict(_made(self.with_(**changes)))

    def scene(self, **changes: object) -> mi.Scene:
        """Load a scene that holds the shape alone. Raises ``Skip`` as well."""
        return mi.load_dict({"type": "scene", "shape": self.load(**changes)})

    def units(self, count: int) -> Array:
        """Random directions [count, 3], uniform over the sphere."""
        return unit(self.rng.normal(size=(count, 3)))

    def uniform(self, *size: int) -> Array:
        return self.rng.random(size, np.float32)

    def numbers(self, *size: int, extreme: float) -> Array:
        """Random numbers, of which a share is at the ends of their range, or in its middle."""
        ends = self.rng.choice(ENDS, size)
        return np.float32(np.where(self.rng.random(size) < extreme, ends, self.uniform(*size)))

    def count(self, quick: int, full: int) -> int:
        """The number of lanes to use."""
        number = quick if self.quick else full
        return max(int(number * SCALAR_SHARE), 64) if is_scalar() else number

    @property
    def waves(self) -> range:
        """One for each wave of lanes in which rare faults show; none in scalar variants."""
        return range(self.count(WAVE, 4 * WAVE) // WAVE)

    def few(self, lanes: Lanes, quick: int, full: int) -> Lanes:
        """The first of some lanes."""
        return lanes[: self.count(quick, full)]

    def program(self, body: str, **names: object) -> str:
        """A program that loads the plugin and runs ``body``, formatted with ``names``."""
        setups = [setup for name, setup in _SETUP.items() if names.get(name) is not None]
        text = "".join(setups) + "\n" + body
        if "variants" in names:
            text = f"mi.set_variant(variant)\nprint(variant)\n{self.word} = load()\n{text}"
            text = "for variant in {variants}:\n" + indent(text, "    ")
        kind = "llvm_ad_" if "PCG32(n)" in text else "scalar_"
        variant = mi.variant().replace("scalar_", kind)
        values = {name: _written(value) for name, value in names.items()}
        first, later = self._imports()
        start = [*first, "import drjit as dr", "import mitsuba as mi", "import numpy as np", ""]
        start += [f"mi.set_variant({variant!r})", *later, ""]
        return "\n".join(start) + self._loading() + text.format(**values)

    def _imports(self) -> tuple[list[str], list[str]]:
        """Lines that register the classes in Python of the plugin: before Mitsuba is imported, and after."""
        objects = [self.plugin]
        with suppress(Exception):  # a traverse() of a plugin in Python may raise
            objects += mi.traverse(self.plugin).hierarchy
        modules = {type(x).__module__ for x in objects}
        first = {PREAMBLES[name] for name in PREAMBLES if any(m.startswith(f"{name}.") for m in modules)}
        known = ("builtins", "mitsuba", "drjit", *PREAMBLES)
        others = sorted(module for module in modules if module.split(".")[0] not in known)
        later = [f"import {module}  # registers its plugins" for module in others if module != "__main__"]
        if "__main__" in others:
            later.append("# register your plugin here")
        return sorted(first), later

    def _loading(self) -> str:
        """The part of a program that defines ``load`` and loads the plugin."""
        source = repr(self.description)
        with suppress(Exception):  # some dicts hold objects without a source text
            if eval(source, {"mi": mi, "np": np}):
                loading = f"mi.load_dict({{**{source}, **more}})"
                return f"\ndef load(**more):\n    return {loading}\n\n{self.word} = load()\n"
        return f"# {self.word}: the object that was checked\nload = lambda: {self.word}\n"

    def elsewhere(self, other: str, call: Callable[[], Result]) -> Result:
        """Call a function in another variant. Raises ``Skip`` where that cannot run."""
        here = mi.variant()
        try:
            try:
                mi.set_variant(other)
            except ImportError as problem:
                raise Skip(f"{other} cannot run here") from problem
            return call()
        except RuntimeError as problem:
            if "not found" not in str(problem):
                raise
            fix = "register it there (mi.detail.add_variant_callback)"
            raise Skip(f"{other} does not know the plugin: {fix}") from None
        finally:
            mi.set_variant(here)

    @property
    def other_kind(self) -> str:
        """The scalar variant of a vectorised one, or the other way around."""
        here = mi.variant()
        return here.replace("scalar_", "llvm_ad_") if is_scalar() else f"scalar_{here.split('_', 2)[-1]}"


READS = "reads beyond the end of an array{said}"
READS_WHY = "they end the process, or return anything: an index that is NaN, or out of range"


@contextmanager
def reads_checked(law: Outcome) -> Iterator[None]:
    """Let Dr.Jit leave out reads beyond arrays, which may end the process, and check that there are none."""
    log = io.StringIO()
    with redirect_stderr(log), dr.scoped_set_flag(dr.JitFlag.Debug, True):
        yield
    lines = log.getvalue().splitlines()
    reads = [line for line in lines if "out-of-bounds" in line]
    law.check("reads", len(reads), said=f": {reads[0]}" if reads else "")
    for line in lines:
        if line not in reads:
            print(line, file=sys.stderr)


def reason_of(problem: BaseException) -> str:
    """The line of an error that says what happened: the last of a traceback that Mitsuba quotes."""
    text = str(problem).strip()
    lines = text.splitlines() or [""]
    return lines[-1] if "Traceback (most recent" in text else lines[0]


def class_name(plugin: mi.Object) -> str:
    """Name of a plugin's class: Mitsuba calls all those in Python by that of their base."""
    python = type(plugin).__module__.split(".")[0] != "mitsuba"
    return type(plugin).__name__ if python or not hasattr(plugin, "class_name") else plugin.class_name()


def _kept(value: Given) -> Given:
    if isinstance(value, dict):
        return {key: _kept(entry) for key, entry in value.items()}
    if hasattr(value, "matrix") and hasattr(value, "inverse_transpose"):
        return Constant("ScalarTransform4f", np.array(value.matrix, np.float64))
    return Constant("TensorXf", np.array(value)) if type(value).__name__.startswith("TensorX") else value


def _made(value: Given) -> Given:
    if isinstance(value, dict):
        return {key: _made(entry) for key, entry in value.items()}
    return getattr(mi, value.kind)(value.values) if isinstance(value, Constant) else value


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
    "point": """
{placed}
it = dr.zeros(mi.SurfaceInteraction3f)
if mi.is_spectral:
    it.wavelengths = type(it.wavelengths)(450, 500, 550, 600)
it.p = mi.Point3f({point})
""",
    "o": """
scene = mi.load_dict({{"type": "scene", "shape": shape}}) if isinstance(shape, mi.Shape) else shape
o, d = mi.Point3f({o}), mi.Vector3f({d})
dr.make_opaque(o, d)
""",
}
