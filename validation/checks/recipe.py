"""Recipes of plugins, which can be loaded more than once and in other variants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.scene.loading import load_dict
from mrt_mitsuba.validation.checks.law import Skip


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
