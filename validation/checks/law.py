"""A plugin under examination, the laws that it must obey, and the result of checking several.

A law's ``snippet`` is a program in plain Mitsuba with the numbers of its worst case. Each law has the body
next to it; ``_SETUP`` comes before it, for the names that are known.
"""

from __future__ import annotations

import ctypes
import math
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import indent
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.scene.loading import load_dict
from mrt_mitsuba.validation.checks.probe import Array, is_scalar, unit
from mrt_mitsuba.validation.tools.study import Bound, Study, notebook, save_report

TITLE = "Laws of plugins"
LEVEL = 1e-6  # chance of a false alarm in each statistical test, after Šidák's correction
SIGMAS = 6  # the same for a normal distribution: 2e-9
Found = TypeVar("Found")
SCALAR_SHARE = 1 / 64  # of the lanes that a vectorised variant gets: others call once for each
TIMEOUT = 120.0  # seconds for each law: sound plugins take a few, those of scalar variants a dozen


class Skip(Exception):
    """Raised by the check of a law that makes no sense: the text says why, and an error that it is from."""


class TimedOut(BaseException):
    """Raised within a law that takes too long. No ``except Exception`` of a plugin catches it."""


@dataclass(frozen=True)
class Part(Bound):
    """A figure that was measured; the note is the reason for its limit, the snippet shows its worst case."""

    figure: str = ""  # its name in the law
    snippet: str = ""


def figures(**rows: tuple[Any, ...]) -> Callable[[Any], Any]:
    """Give a law its figures, by name: how, what is held to which limit, why that, and a snippet's body.

    How: a number "at most" or "at least"; or of N errors the "most", "none" or a "share" of those that are
    bad, or a quantile, NaN left out.
    """

    def mark(law: Any) -> Any:
        law.figures = rows
        return law

    return mark


def rare(what: str, *body: str) -> tuple[Any, ...]:
    """Return the row of a figure that is the chance of what was seen, if a plugin is sound."""
    return "at least", what, LEVEL, "one false alarm in a million checks", *body


@dataclass
class Law:
    """One law: its figures, or why it was skipped. ``measured``, ``limit``, ``why`` are of the worst one."""

    name: str
    parts: list[Part] = field(default_factory=list)
    skipped: str = ""
    notes: list[str] = field(default_factory=list)
    figures: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    program: Callable[..., str] | None = None  # writes snippets, while the law is checked

    def hold(self, name: str, measured: Any, *, limit: Any = None, **names: Any) -> None:
        """Hold a figure, a number or N errors, to its limit.

        ``names`` fill its words and its snippet: values, or arrays that have a row for each error.
        """
        how, what, usual, why, *body = self.figures[name]
        if how not in ("at most", "at least"):
            errors = np.asarray(measured, np.float64)
            if isinstance(how, float):
                measured = np.nanquantile(errors, how)
                i = int(np.nanargmin(np.abs(errors - measured)))
            else:
                i = int(np.where(np.isnan(errors), np.inf, errors).argmax())
                measured = {"most": errors[i], "none": errors.sum(), "share": errors.mean()}[how]
            names = {key: x[i] if isinstance(x, np.ndarray) else x for key, x in names.items()}
        snippet = self.program(*body, **names) if self.program and body else ""
        figures = float(measured), float(usual if limit is None else limit)
        self.parts.append(Part(what.format(**names), *figures, how != "at least", why, name, snippet))

    @property
    def worst(self) -> Part:
        """Return the figure that uses most of its limit."""

        def used(part: Part) -> float:
            over, under = (part.measured, part.limit)[:: 1 if part.at_most else -1]
            return math.inf if not part.holds else over / under if under > 0 else 0.0

        return max(self.parts, key=used, default=Part("", math.nan, math.nan))

    measured = property(lambda self: self.worst.measured)
    limit = property(lambda self: self.worst.limit)
    why = property(lambda self: self.worst.note)
    snippet = property(lambda self: self.worst.snippet)

    @property
    def holds(self) -> bool:
        """Return whether every figure is within its limit; a skipped law does not fail."""
        return bool(self.skipped) or (bool(self.parts) and all(part.holds for part in self.parts))

    @property
    def note(self) -> str:
        """Return what the worst figure is, and remarks."""
        return "; ".join([*([self.worst.name] if self.parts else []), *self.notes])

    @property
    def verdict(self) -> str:
        return "skipped" if self.skipped else "holds" if self.holds else "FAILS"

    def __str__(self) -> str:
        figure = f"{self.measured:.4g} {self.worst.sign} {self.limit:.4g}, {self.note}"
        return f"{self.verdict:<7} {self.name}: {self.skipped or figure}"


@dataclass(frozen=True)
class Check:
    """The findings of a check of one plugin: its laws by name."""

    subject: str
    variant: str
    laws: Mapping[str, Law]
    seconds: float
    quick: bool = False

    @property
    def failed(self) -> list[str]:
        """Return the names of the laws that do not hold."""
        return [name for name, law in self.laws.items() if not law.holds]

    @property
    def passed(self) -> bool:
        """Return whether something was checked and every law that was holds."""
        return not self.failed and any(not law.skipped for law in self.laws.values())

    def __str__(self) -> str:
        verdict = "passed" if self.passed else f"FAILED {', '.join(self.failed)}"
        lines = [f"{self.subject} in {self.variant}: {verdict} ({self.seconds:.1f} s)"]
        return "\n".join(lines + [f"  {law}" for law in self.laws.values()])

    def study(self) -> Study:
        """Return the findings in the form that pages are made of."""
        laws = self.laws.values()
        study = Study(self.subject, f"{self.subject}, {self.variant}", seconds=self.seconds)
        study.bounds += [replace(p, name=f"{law.name}: {p.name}") for law in laws for p in law.parts]
        rows = [
            [law.name, law.verdict, law.skipped or law.note, "" if law.holds else law.snippet] for law in laws
        ]
        columns = ["law", "verdict", "note", "the worst case, to run by itself"]
        study.table("laws", "Laws", columns, rows, first=True)
        return study

    def save(self, folder: str | Path) -> None:
        """Write the page (``index.html``), ``summary.json`` and CSV files. Raises ``OutputError``."""
        save_report(folder, self.study(), title=TITLE, quick=self.quick)

    def _repr_html_(self) -> str:
        return notebook(self.study(), title=TITLE)


@dataclass(frozen=True, repr=False)
class Kept:
    """A tensor or transform of a dict: loading uses up the one, and the other's type is the variant's."""

    kind: str  # what makes it: "TensorXf" or "ScalarTransform4f"
    values: np.ndarray

    def __repr__(self) -> str:
        """Return it as Python; there is none of large ones."""
        array = f"np.array({self.values.tolist()}, np.float32)"
        return f"mi.{self.kind}({array})" if self.values.size <= 64 else "<many numbers>"


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
        word, given = self.word, repr(self.description)
        text = "".join(setup for name, setup in _SETUP.items() if names.get(name) is not None) + "\n" + body
        if "variants" in names:
            text = f"mi.set_variant(variant)\nprint(variant)\n{word} = load()\n{text}"
            text = "for variant in {variants}:\n" + indent(text, "    ")
        variant = mi.variant().replace("scalar_", "llvm_ad_" if "PCG32(n)" in text else "scalar_")
        load = f"# {word}: the object that was checked\nload = lambda: {word}\n"
        ours, stock = "'mrt_" in given, type(self.plugin).__module__.startswith("mitsuba")
        with suppress(Exception):  # of what some dicts hold there is no source
            if eval(given, {"mi": mi, "np": np}):
                load = "" if ours or stock else f"# register {self.name!r} here\n"
                whole = f"mi.load_dict({{**{given}, **more}})"
                load += f"\ndef load(**more):\n    return {whole}\n\n{word} = load()\n"
        start = "import mrt_mitsuba as mrt  # before mitsuba\n" if ours else ""
        start += "import drjit as dr\nimport mitsuba as mi\nimport numpy as np\n\n"
        start += f"mi.set_variant({variant!r})\n" + ("mrt.register()\n" if ours else "")
        return start + load + text.format(**{name: _written(value) for name, value in names.items()})

    def elsewhere(self, other: str, call: Callable[[], Found]) -> Found:
        """Return what a function gives in another variant. Raises ``Skip`` where there is none."""
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
            mi.set_variant(here)

    @property
    def other_kind(self) -> str:
        """The scalar variant of a vectorised one, or the other way around."""
        here = mi.variant()
        return here.replace("scalar_", "llvm_ad_") if is_scalar() else f"scalar_{here.split('_', 2)[-1]}"


def class_name(plugin: Any) -> str:
    """Return the name of a plugin's class: Mitsuba calls all those in Python by that of their base."""
    python = type(plugin).__module__.split(".")[0] != "mitsuba"
    return type(plugin).__name__ if python or not hasattr(plugin, "class_name") else plugin.class_name()


def _reason(problem: BaseException) -> str:
    """Return the line of an error that says what happened: the last of a traceback that Mitsuba quotes."""
    text = str(problem).strip()
    return text.splitlines()[-1 if "Traceback (most recent" in text else 0] if text else ""


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


def _written(value: Any) -> str:
    """Return a value as Python text; float32 in the fewest digits that give it back."""
    if isinstance(value, np.ndarray):
        inner = ", ".join(str(x) for x in value.astype(np.float32))
        return inner if value.dtype == np.float32 and len(value) in (2, 3) else f"[{inner}]"
    return value if isinstance(value, str) else repr(value.item() if isinstance(value, np.generic) else value)


def examine(
    kind: Callable[[Any, bool, int], Any],
    given: Any,
    laws: Mapping[str, Callable[[Law, Any], None]],
    *,
    quick: bool,
    seed: int,
    only: Iterable[str] | None = None,
    timeout: float = TIMEOUT,
) -> Check:
    """Check laws one by one; a law fails if the plugin raises while it is checked, or takes too long.

    ``kind(given, quick, seed)`` makes the case that each law is called with.
    """
    runtime.use()
    chosen = list(laws if only is None else only)
    if unknown := [name for name in chosen if name not in laws]:
        raise UsageError(f"unknown law {unknown[0]!r}: choose from {', '.join(laws)}")
    start, variant, found, late = time.perf_counter(), mi.variant(), {}, ""
    with settings_restored():
        case = kind(given, quick, seed)
    for name in (name for name in laws if name in chosen):
        law = found[name] = Law(name, figures=vars(laws[name])["figures"], program=case.program)
        try:
            with settings_restored(), _limited(timeout):
                if late:
                    raise Skip(f"a law before it {late}")
                laws[name](law, case)
            law.skipped = "" if law.parts else "; ".join(law.notes)
        except Skip as why:
            law.skipped = f"{why}: {_reason(why.__cause__)}" if why.__cause__ else str(why)
        except TimedOut:
            late = f"took longer than {timeout:g} s"
            law.parts.append(Part(f"it {late}", math.inf, timeout, note="a plugin must come to an end"))
        except Exception as error:
            what = f"it raised {type(error).__name__}: {_reason(error)}"
            law.parts.append(Part(what, math.inf, 0, note="a plugin must not raise"))
        law.program = None
    return Check(case.name, variant, found, time.perf_counter() - start, quick)


@contextmanager
def settings_restored() -> Iterator[None]:
    """Put back the variant and Dr.Jit's flags, which a plugin or a switch of variants may change."""
    variant, flags = mi.variant(), {f: dr.flag(f) for f in dr.JitFlag if f != dr.JitFlag.Default}
    try:
        # what is not finite is the law ``finite``'s to deal with
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # Mitsuba loads its integrators anew with each variant, and Dr.Jit counts how often
            warnings.filterwarnings("ignore", "The AST-transforming decorator")
            yield
    finally:
        if mi.variant() != variant:
            mi.set_variant(variant)
        for flag, value in flags.items():
            if dr.flag(flag) != value:
                dr.set_flag(flag, value)


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise ``TimedOut`` in this thread's Python code after so many seconds. A kernel is not interrupted."""
    start, raised = time.perf_counter(), (ctypes.c_ulong(threading.get_ident()), ctypes.py_object(TimedOut))
    timer = threading.Timer(seconds, ctypes.pythonapi.PyThreadState_SetAsyncExc, raised)
    timer.daemon = True
    timer.start()
    try:
        yield
    except Exception as error:  # Mitsuba passes on what a Python plugin raises as an error of its own
        if time.perf_counter() - start > seconds:
            raise TimedOut from error
        raise
    finally:
        timer.cancel()
        timer.join()  # if it is about to interrupt: then it does here, and not later


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
