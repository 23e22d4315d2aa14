"""``check_scene``: every BSDF, shape and emitter of a scene by its laws, and its picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from .bsdf import check_bsdf
from .case import class_name
from .emitter import check_emitter
from .page import Check, Findings, files_of
from .shape import check_shape

Plugin = tuple[str, int, mi.Object]  # its kind, and its number among those of the kind
MAX_PER_KIND = 6  # plugins of one kind that are checked, spread over all


@dataclass(frozen=True)
class SceneCheck(Findings):
    """The findings of a check of a scene: for each plugin, by name, and for the picture."""

    name: str
    checks: Mapping[str, Check]
    fault: str  #: which pixels are not finite, "" if all are
    left_out: tuple[str, ...] = ()

    @property
    def failed(self) -> list[str]:
        """Failed laws, as "name: law", and "pixels" where some are not finite."""
        laws = [f"{name}: {law}" for name, check in self.checks.items() for law in check.failed]
        return laws + (["pixels"] if self.fault else [])

    @property
    def passed(self) -> bool:
        return not self.failed

    def __str__(self) -> str:
        lines = [str(check) if check.failed else str(check).splitlines()[0] for check in self.checks.values()]
        lines += [*self.left_out, self.fault or "every pixel is finite"]
        return "\n".join([*lines, f"{self.name}: {'passed' if self.passed else 'FAILED'}"])

    def files(self) -> dict[str, bytes]:
        remarks = [self.fault or "every pixel is finite", *self.left_out]
        return files_of(self.name, self.checks, passed=self.passed, remarks=remarks)


def check_scene(
    scene: mi.Scene,
    *,
    integrator: mi.Integrator | None = None,
    sensor: mi.Sensor | None = None,
    name: str = "scene",
    quick: bool = False,
    seed: int = 0,
    progress: Callable[[Sequence[Plugin]], Iterable[Plugin]] = iter,
) -> SceneCheck:
    """Check every BSDF, shape and emitter of a loaded scene, and look for pixels that are not finite.

    ``integrator`` and ``sensor`` default to the scene's own. Only some of many plugins of one kind are
    checked. ``progress`` iterates over them, as ``tqdm.tqdm`` does.
    """
    chosen = []
    left_out = []
    for kind, alike in _plugins(scene).items():
        some = range(0, len(alike), max(len(alike) // MAX_PER_KIND, 1))
        chosen += [(kind, number, alike[number]) for number in some]
        if len(alike) > len(some):
            left_out.append(f"{len(alike) - len(some)} more of {kind} are like those that were checked")
    checks: dict[str, Check] = {}
    for kind, number, plugin in progress(chosen):
        title = f"{kind} {plugin.id() or number}"
        if title in checks:
            title = f"{title} ({number})"
        if kind.startswith("BSDF"):
            check = check_bsdf(plugin, quick=quick, seed=seed)
        elif kind.startswith("shape"):
            check = check_shape(plugin, quick=quick, seed=seed)
        else:
            check = check_emitter(plugin, scene=scene, quick=quick, seed=seed)
        checks[title] = replace(check, subject=title)
    instances = sum(shape.class_name() == "Instance" for shape in scene.shapes())
    if instances:
        left_out.append(f"{instances} instances are not checked")
    fault = _bad_pixels(scene, integrator, sensor or scene.sensors()[0], 4 if quick else 32, seed)
    return SceneCheck(name, checks, fault, tuple(left_out))


def _plugins(scene: mi.Scene) -> dict[str, list[mi.Object]]:
    """The BSDFs, shapes and emitters of a scene, each once, by kind, but for instances."""
    shapes = [shape for shape in scene.shapes() if shape.class_name() != "Instance"]
    bsdfs = {id(bsdf): bsdf for bsdf in (shape.bsdf() for shape in shapes) if bsdf is not None}
    kinds: dict[str, list[mi.Object]] = {}
    for word, plugins in (("BSDF", bsdfs.values()), ("shape", shapes), ("emitter", scene.emitters())):
        for plugin in plugins:
            kinds.setdefault(f"{word} {class_name(plugin)}", []).append(plugin)
    return kinds


def _bad_pixels(
    scene: mi.Scene, integrator: mi.Integrator | None, sensor: mi.Sensor, spp: int, seed: int
) -> str:
    """Number of pixels that are not finite, and the first of them on the film; "" if all are finite."""
    picture = mi.render(scene, integrator=integrator, sensor=sensor, spp=spp, seed=seed)
    bad = np.argwhere(~np.isfinite(np.array(picture)).all(axis=-1))
    if not len(bad):
        return ""
    left, top = sensor.film().crop_offset()
    y, x = bad[0]
    return f"{len(bad)} pixels are not finite; the first: ({x + int(left)}, {y + int(top)})"
