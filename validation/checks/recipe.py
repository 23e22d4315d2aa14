"""A plugin under examination: by its dict, it can be loaded more than once and in other variants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.scene.loading import load_dict
from mrt_mitsuba.validation.checks.law import Skip, class_name
from mrt_mitsuba.validation.checks.probe import SCALAR_SHARE, Array, is_scalar, unit

Found = TypeVar("Found")


@dataclass(frozen=True)
class Kept:
    """A tensor or transform of a dict: loading uses up the one, and the other's type is the variant's."""

    kind: str  # what makes it: "TensorXf" or "ScalarTransform4f"
    values: np.ndarray


class Subject:
    """A plugin under examination, given by its dict or loaded, and how thorough to be."""

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
        groups = [
            k for k, value in given.items() if isinstance(value, dict) and value["type"] == "shapegroup"
        ]
        nodes = {"shape": given}
        if given.get("type") == "instance" and groups:
            reference = {"type": "ref", "id": "group"}
            nodes = {"group": given[groups[0]], "shape": {**given, groups[0]: reference}}
        return mi.load_dict({"type": "scene", **_made(nodes)})

    def units(self, count: int) -> Array:
        """Return directions over the whole sphere."""
        return unit(self.rng.normal(size=(count, 3)))

    def count(self, quick: int, full: int) -> int:
        """Return how many lanes to use."""
        number = quick if self.quick else full
        return max(int(number * SCALAR_SHARE), 64) if is_scalar() else number


def row(names: Mapping[str, Any], i: int) -> dict[str, Any]:
    """Return values by name, of arrays one row."""
    return {name: value[i] if isinstance(value, np.ndarray) else value for name, value in names.items()}


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


def source(value: Any) -> str | None:
    """Return a kept dict's value as Python; None where it holds what has no source."""
    if isinstance(value, dict):
        parts = {key: source(entry) for key, entry in value.items()}
        inner = ", ".join(f"{key!r}: {text}" for key, text in parts.items())
        return None if None in parts.values() else f"{{{inner}}}"
    if isinstance(value, Kept) and value.kind == "ScalarTransform4f":
        return f"mi.ScalarTransform4f({value.values.tolist()})"
    if isinstance(value, Kept) and value.values.size <= 64:
        flat = [float(x) for x in value.values.ravel()]
        return f"mi.TensorXf(np.array({flat}, np.float32).reshape({value.values.shape}))"
    if isinstance(value, (list, tuple)):
        entries = [source(entry) for entry in value]
        return None if None in entries else f"[{', '.join(map(str, entries))}]"
    return repr(value) if isinstance(value, (bool, int, float, str)) else None
