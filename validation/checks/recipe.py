"""Recipes of plugins, which can be loaded more than once and in other variants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.scene.loading import load_dict
from mrt_mitsuba.validation.checks.law import Skip, class_name
from mrt_mitsuba.validation.checks.probe import SCALAR_SHARE, is_scalar

Found = TypeVar("Found")


@dataclass(frozen=True)
class Tensor:
    """A tensor of a dict: Mitsuba's textures take it away from the dict that they are loaded from."""

    values: np.ndarray


@dataclass(frozen=True)
class Transform:
    """A transform of a dict, whose type is the variant's."""

    matrix: np.ndarray


@dataclass(frozen=True)
class Recipe:
    """The dict of a plugin, or None where a loaded object was given."""

    description: dict[str, Any] | None

    @staticmethod
    def of(given: Any) -> Recipe:
        return Recipe(_kept(given) if isinstance(given, dict) else None)

    def load(self) -> Any:
        """Load it in the current variant. Raises ``Skip`` without a dict."""
        if self.description is None:
            raise Skip("a loaded object was given: this needs the dict that it is made from")
        return mi.load_dict(_made(self.description))

    def open(self) -> Any:
        """Load it for the first time. Raises ``SceneError`` for a dict that is none of a plugin."""
        return load_dict(_made(self.description), f"the {(self.description or {}).get('type', 'dict')}")

    def scene(self) -> Any:
        """Load a scene that holds the shape alone, or an instance with its group. Raises ``Skip`` as well."""
        given = self.description or {}
        groups = [
            key for key, value in given.items() if isinstance(value, dict) and value["type"] == "shapegroup"
        ]
        if given.get("type") != "instance" or not groups:
            return mi.load_dict({"type": "scene", "shape": self.load()})
        reference = {"type": "ref", "id": "group"}
        nodes = {"group": given[groups[0]], "shape": {**given, groups[0]: reference}}
        return mi.load_dict({"type": "scene", **_made(nodes)})

    def with_(self, **changes: Any) -> Recipe:
        """Return a recipe with other values of some parameters."""
        if self.description is None:
            raise Skip("a loaded object was given: this needs the dict that it is made from")
        return Recipe({**self.description, **_kept(changes)})


@dataclass
class Subject:
    """A plugin under examination, and how thorough to be."""

    plugin: Any
    recipe: Recipe
    quick: bool
    seed: int

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def count(self, quick: int, full: int) -> int:
        """Return how many lanes to use."""
        number = quick if self.quick else full
        return max(int(number * SCALAR_SHARE), 64) if is_scalar() else number


def opened(given: Any) -> tuple[Any, Recipe, str]:
    """Return a plugin by its dict, or one that is loaded, with its recipe and name."""
    runtime.use()
    recipe = Recipe.of(given)
    if recipe.description is None:
        return given, recipe, class_name(given)
    return recipe.open(), recipe, recipe.description["type"]


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
        return Transform(np.array(value.matrix, np.float64))
    return Tensor(np.array(value)) if type(value).__name__.startswith("TensorX") else value


def _made(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _made(entry) for key, entry in value.items()}
    if isinstance(value, Transform):
        return mi.ScalarTransform4f(value.matrix)
    return mi.TensorXf(value.values) if isinstance(value, Tensor) else value


def source(value: Any) -> str | None:
    """Return a recipe's value as Python; None where it holds what has no source."""
    if isinstance(value, dict):
        parts = {key: source(entry) for key, entry in value.items()}
        inner = ", ".join(f"{key!r}: {text}" for key, text in parts.items())
        return None if None in parts.values() else f"{{{inner}}}"
    if isinstance(value, Transform):
        return f"mi.ScalarTransform4f({value.matrix.tolist()})"
    if isinstance(value, Tensor) and value.values.size <= 64:
        shape, flat = value.values.shape, [float(x) for x in value.values.ravel()]
        return f"mi.TensorXf(np.array({flat}, np.float32).reshape({shape}))"
    if isinstance(value, (list, tuple)):
        entries = [source(entry) for entry in value]
        return None if None in entries else f"[{', '.join(map(str, entries))}]"
    return repr(value) if isinstance(value, (bool, int, float, str)) else None
