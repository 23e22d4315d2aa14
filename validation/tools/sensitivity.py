"""Where a picture hangs on decisions that float32 may make otherwise, found in the float64 reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.validation.oracles.reference import ReferenceResult, reference_render


@dataclass(frozen=True)
class Sensitivity:
    """The changes in a pixel when its ray is moved by a small part of a pixel; all [H, W].

    Every pixel is of at most one kind: ``silhouette`` where the rays meet other objects, else ``shadow``
    where a light appears or vanishes (the edge of a shadow, or a terminator). ``spread`` is the largest
    difference in a channel.
    """

    reference: ReferenceResult
    silhouette: np.ndarray  # bool
    shadow: np.ndarray  # bool
    spread: np.ndarray  # float64


def sensitivity(
    scene: Scene, *, width: int, height: int, displacement: float = 1e-2, **settings: Any
) -> Sensitivity:
    """Compare the reference with four displaced by ``displacement`` pixels, left, right, down and up.

    ``settings`` are those of ``reference_render``, with ``aa`` = 1.
    """
    steps = [(displacement, 0.0), (-displacement, 0.0), (0.0, displacement), (0.0, -displacement)]
    reference = reference_render(scene, width=width, height=height, **settings)
    others = [reference_render(scene, width=width, height=height, displacement=s, **settings) for s in steps]
    silhouette = np.any([other.path != reference.path for other in others], axis=0)
    shadow = np.any([other.lights != reference.lights for other in others], axis=0) & ~silhouette
    spread = np.max([np.abs(other.image - reference.image).max(axis=-1) for other in others], axis=0)
    return Sensitivity(reference, silhouette, shadow, spread)
