"""A plugin under examination, the laws that it must obey, and the result of checking several.

A law's ``snippet`` is a program in plain Mitsuba with the numbers of its worst case. Each law has the body
next to it; ``_SETUP`` comes before it, for the names that are known.
"""

from __future__ import annotations

import ctypes
import math
import re
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from textwrap import indent
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.scene.loading import load_dict
from mrt_mitsuba.validation.checks.probe import Array, Lanes, is_scalar, stratified, unit
from mrt_mitsuba.validation.tools.study import Bound, Study, notebook, save_report

TITLE = "Laws of plugins"
LEVEL = 1e-6  # chance of a false alarm in each statistical test, after Šidák's correction
ONE_IN_A_MILLION = "one false alarm in a million checks"
SIGMAS = 6  # the same for a normal distribution: 2e-9
Found = TypeVar("Found")
Description = dict[str, Any]  # of a plugin, as ``mi.load_dict`` takes it
Given = Any  # such a dict, a value of one, or a loaded plugin
SCALAR_SHARE = 1 / 64  # of the lanes that a vectorised variant gets: others call once for each
NOWHERE = Lanes()
TIMEOUT = 120.0  # seconds for each law: sound plugins take a few, those of scalar variants a dozen


class Skip(Exception):
    """Raised by the check of a law that makes no sense: the text says why, and an error that it is from."""


class TimedOut(BaseException):
    """Raised within a law that takes too long. No ``except Exception`` of a plugin catches it."""


@dataclass(frozen=True)
class Figure:
    """What a law measures, and the limit that it is held to.

    ``statistic``: a number "at most" or "at least" the limit; or, of N errors, the "most", the "count" or the
    "share" of those that are wrong, or a quantile (a float) without NaN. ``what`` and ``snippet``, the body
    of a program that shows the worst case, have places for the names given to ``Law.hold``.
    """

    statistic: str | float
    what: str
    limit: float
    why: str
    snippet: str = ""


# A figure by its statistic: what it is, its limit, the reason for that, and a snippet
at_most = partial(Figure, "at most")
at_least = partial(Figure, "at least")
most = partial(Figure, "most")
number_of = partial(Figure, "count")
share_of = partial(Figure, "share")


@dataclass(frozen=True)
class Part(Bound):
    """A figure that was measured; the note is the reason for its limit, the snippet shows its worst case."""

    figure: str = ""  # its name in the law
    snippet: str = ""


def figures(**rows: Figure) -> Callable[[Found], Found]:
    """Give a law the figures that it measures, by name."""

    def mark(law: Found) -> Found:
        vars(law)["figures"] = rows
        return law

    return mark


def rare(what: str, snippet: str = "") -> Figure:
    """The chance of what was seen, if a plugin is sound."""
    return at_least(what, LEVEL, ONE_IN_A_MILLION, snippet)


@dataclass
class Law:
    """One law: its figures, or why it was skipped. ``measured``, ``limit``, ``why`` are of the worst one."""

    name: str
    parts: list[Part] = field(default_factory=list)
    skipped: str = ""
    notes: list[str] = field(default_factory=list)
    figures: Mapping[str, Figure] = field(default_factory=dict)
    program: Callable[..., str] | None = None  # writes snippets, while the law is checked

    def hold(
        self, name: str, measured: ArrayLike, at: Lanes = NOWHERE, *, limit: float | None = None, **names: Any
    ) -> None:
        """Hold a figure, a number or N errors, to its limit.

        ``at`` and ``names`` fill its words and its snippet: values, or arrays that have a row for each error.
        """
        figure = self.figures[name]
        errors = np.asarray(measured, np.float64)
        names = vars(at) | names
        if figure.statistic in ("at most", "at least"):
            amount = float(errors)
        else:
            worst = np.where(np.isnan(errors), np.inf, errors).argmax()
            amount = errors[worst]
            if figure.statistic == "count":
                amount = errors.sum()
            elif figure.statistic == "share":
                amount = errors.mean()
            elif isinstance(figure.statistic, float):
                amount = np.nanquantile(errors, figure.statistic)
                worst = np.nanargmin(abs(errors - amount))
            names = {key: x[worst] if isinstance(x, np.ndarray) else x for key, x in names.items()}
        snippet = ""
        if self.program and figure.snippet:
            snippet = self.program(figure.snippet, **names)
        part = Part(
            name=figure.what.format(**names),
            measured=float(amount),
            limit=float(figure.limit if limit is None else limit),
            at_most=figure.statistic != "at least",
            note=figure.why,
            figure=name,
            snippet=snippet,
        )
        self.parts.append(part)

    @property
    def worst(self) -> Part:
        """The figure that uses most of its limit."""
        return max(self.parts, key=_used, default=Part("", math.nan, math.nan))

    @property
    def measured(self) -> float:
        return self.worst.measured

    @property
    def limit(self) -> float:
        return self.worst.limit

    @property
    def why(self) -> str:
        return self.worst.note

    @property
    def snippet(self) -> str:
        return self.worst.snippet

    @property
    def holds(self) -> bool:
        """Whether every figure is within its limit; a skipped law does not fail."""
        if self.skipped:
            return True
        return bool(self.parts) and all(part.holds for part in self.parts)

    @property
    def note(self) -> str:
        """The worst figure in words, and remarks."""
        name = [self.worst.name] if self.parts else []
        return "; ".join(name + self.notes)

    @property
    def verdict(self) -> str:
        if self.skipped:
            return "skipped"
        return "holds" if self.holds else "FAILS"

    def __str__(self) -> str:
        text = self.skipped
        if not text:
            text = f"{self.measured:.4g} {self.worst.sign} {self.limit:.4g}, {self.note}"
        return f"{self.verdict:<7} {self.name}: {text}"


Judge = Callable[[Law, Any], None]  # checks one law of a case


def _used(part: Part) -> float:
    """The share of its limit that a figure uses; infinity beyond it."""
    if not part.holds:
        return math.inf
    over = part.measured if part.at_most else part.limit
    under = part.limit if part.at_most else part.measured
    return over / under if under > 0 else 0.0


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
        """Names of the laws that do not hold."""
        return [name for name, law in self.laws.items() if not law.holds]

    @property
    def passed(self) -> bool:
        """Whether something was checked and every law that was checked holds."""
        return not self.failed and any(not law.skipped for law in self.laws.values())

    def __str__(self) -> str:
        verdict = "passed" if self.passed else "skipped, nothing could be checked"
        if self.failed:
            verdict = f"FAILED {', '.join(self.failed)}"
        title = f"{self.subject} in {self.variant}: {verdict} ({self.seconds:.1f} s)"
        return "\n".join([title, *(f"  {law}" for law in self.laws.values())])

    def study(self) -> Study:
        """The findings in the form that pages are made of."""
        study = Study(self.subject, f"{self.subject}, {self.variant}", seconds=self.seconds)
        columns = ["law", "verdict", "note", "the worst case, to run by itself"]
        rows = []
        for law in self.laws.values():
            study.bounds += [replace(part, name=f"{law.name}: {part.name}") for part in law.parts]
            snippet = "" if law.holds else law.snippet
            rows.append([law.name, law.verdict, law.skipped or law.note, snippet])
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
        self.unsupported = ""  # what Mitsuba's own warnings say against it
        if isinstance(given, dict):
            self.description = _kept(given)
            self.name = str(given.get("type", "dict"))
            with _warnings_of_mitsuba() as lines:
                self.plugin: mi.Object = load_dict(_made(self.description), f"the {self.name}")
            self.unsupported = _refusal(lines)
        else:
            self.name = class_name(given)
            self.plugin = given

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
            mi.set_variant(here)

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
    with dr.suspend_grad():
        bad, columns = call(stratified(count, case.seed))
        dr.eval(bad, *columns.values())
        wrong = dr.compress(bad)
    index = wrong[0] if dr.width(wrong) else 0
    first = {name: np.float32(np.array(x)[:, index]) for name, x in columns.items()}
    law.hold("million", dr.width(wrong), count=count, **first)


def class_name(plugin: mi.Object) -> str:
    """Name of a plugin's class: Mitsuba calls all those in Python by that of their base."""
    python = type(plugin).__module__.split(".")[0] != "mitsuba"
    return type(plugin).__name__ if python or not hasattr(plugin, "class_name") else plugin.class_name()


def _reason(problem: BaseException) -> str:
    """The line of an error that says what happened: the last of a traceback that Mitsuba quotes."""
    text = str(problem).strip()
    lines = text.splitlines() or [""]
    return lines[-1] if "Traceback (most recent" in text else lines[0]


_NOT_IMPLEMENTED = re.compile(r"\[(\w+)\] \w+::(\w+)\(\).*not implemented")
_PURE_VIRTUAL = re.compile(r"(\w+)::(\w+)\(\)'\): tried to call a pure virtual")


def _missing_inside(plugin: mi.Object, error: Exception) -> str:
    """Which method a plugin nested in this one lacks, if an error is about that; else ""."""
    match = _NOT_IMPLEMENTED.search(str(error)) or _PURE_VIRTUAL.search(str(error))
    if match is None or match[1] in [base.__name__ for base in type(plugin).__mro__]:
        return ""
    return f"the {match[1]} nested in it has no {match[2]}(), which it needs"


@contextmanager
def _warnings_of_mitsuba() -> Iterator[list[str]]:
    """A list that has the lines of Mitsuba's warnings, once the block is left."""
    lines: list[str] = []
    logger = mi.logger()
    level = logger.log_level()
    printers = [logger.appender(i) for i in range(logger.appender_count())]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "log")
        # to a file: a callback in Python may deadlock with Mitsuba's threads
        appender = mi.StreamAppender(str(path))
        quiet = level > mi.LogLevel.Warn
        for printer in printers if quiet else ():
            logger.remove_appender(printer)
        logger.add_appender(appender)
        logger.set_log_level(min(level, mi.LogLevel.Warn))
        try:
            yield lines
        finally:
            logger.set_log_level(level)
            logger.remove_appender(appender)
            for printer in printers if quiet else ():
                logger.add_appender(printer)
            del appender
            lines += path.read_text(errors="replace").splitlines()


def _refusal(lines: Iterable[str]) -> str:
    """The first of Mitsuba's warnings that says that something is not supported; else ""."""
    for line in lines:
        words = line.partition(" WARN ")[2].strip()
        if re.search(r"shouldn't|should not|n.t support|unsupported", words):
            return f"Mitsuba does not support it: {words}"
    return ""


def refused(description: Description) -> str:
    """What Mitsuba's warnings say against a plugin of a dict, "" if nothing."""
    with _warnings_of_mitsuba() as lines, suppress(RuntimeError):
        mi.load_dict(description)
    return _refusal(lines)


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


def examine(
    kind: Callable[[Given, bool, int], Subject],
    given: Given,
    laws: Mapping[str, Judge],
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
    for name in chosen:
        if name not in laws:
            raise UsageError(f"unknown law {name!r}: choose from {', '.join(laws)}")
    start = time.perf_counter()
    variant = mi.variant()
    with settings_restored():
        case = kind(given, quick, seed)
    checked = {}
    obstacle = case.unsupported  # why the laws that are left cannot be judged
    for name in laws:
        if name in chosen:
            law = Law(name, figures=vars(laws[name])["figures"], program=case.program)
            obstacle = _judge(law, laws[name], case, obstacle, timeout)
            law.program = None
            checked[name] = law
    return Check(case.name, variant, checked, time.perf_counter() - start, quick)


def _judge(law: Law, judge: Judge, case: Subject, obstacle: str, timeout: float) -> str:
    """Check one law, unless there is an obstacle; the obstacle for the laws after it, "" if none."""
    if obstacle:
        law.skipped = obstacle
        return obstacle
    try:
        with settings_restored(), _limited(timeout):
            judge(law, case)
        if not law.parts:
            law.skipped = "; ".join(law.notes)
    except Skip as why:
        law.skipped = f"{why}: {_reason(why.__cause__)}" if why.__cause__ else str(why)
    except TimedOut:
        late = f"took longer than {timeout:g} s"
        law.parts.append(Part(f"it {late}", math.inf, timeout, note="a plugin must come to an end"))
        return f"a law before it {late}"
    except Exception as error:
        law.skipped = _missing_inside(case.plugin, error)
        if not law.skipped:
            what = f"it raised {type(error).__name__}: {_reason(error)}"
            law.parts.append(Part(what, math.inf, 0, note="a plugin must not raise"))
    return ""


@contextmanager
def settings_restored() -> Iterator[None]:
    """Put back the variant and Dr.Jit's flags, which a plugin or a switch of variants may change."""
    variant = mi.variant()
    flags = {flag: dr.flag(flag) for flag in dr.JitFlag if flag != dr.JitFlag.Default}
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
    start = time.perf_counter()
    thread = ctypes.c_ulong(threading.get_ident())
    interrupt = ctypes.pythonapi.PyThreadState_SetAsyncExc
    timer = threading.Timer(seconds, interrupt, (thread, ctypes.py_object(TimedOut)))
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
