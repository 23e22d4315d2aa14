"""``mrt.check_*``: the laws of plugins, for scenes as this package opens them, and with its errors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.files.replacing import replacing
from mrt_mitsuba.options import StrPath
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation import laws
from mrt_mitsuba.validation.laws.case import PREAMBLES
from mrt_mitsuba.validation.page import prepare_folder

PREAMBLES["mrt_mitsuba"] = "import mrt_mitsuba as mrt  # before mitsuba\n\nmrt.register()"


@contextmanager
def _with_our_errors() -> Iterator[None]:
    try:
        yield
    except laws.UsageError as error:
        raise UsageError(str(error)) from error
    except laws.LoadError as error:
        raise SceneError(str(error)) from error


class _Saved(laws.Findings):
    """A result whose page this package writes."""

    def save(self, folder: StrPath) -> None:
        """Write a page (``index.html``), ``summary.json`` and ``laws.csv``, all or none. Raises
        ``OutputError``.
        """
        files = self.files()
        prepare_folder(Path(folder), *files)
        with replacing(*(Path(folder) / name for name in files)) as opened:
            for file, content in zip(opened, files.values(), strict=True):
                file.write(content)


class Check(_Saved, laws.Check):
    """The findings of a check of one plugin."""


class SceneCheck(_Saved, laws.SceneCheck):
    """The findings of a check of a scene."""


def check_bsdf(
    bsdf: Any,
    *,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
) -> Check:
    """Check the laws of a BSDF in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    ``quick``: fewer angles and samples. ``only``: names of laws. A loaded BSDF skips what has to load it
    again. Raises ``UsageError`` for anything else, and ``SceneError`` for a dict that Mitsuba cannot load.
    """
    runtime.use()
    with _with_our_errors():
        return Check(**vars(laws.check_bsdf(bsdf, quick=quick, seed=seed, only=only)))


def check_shape(
    shape: Any,
    *,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
) -> Check:
    """Check the laws of a shape; see ``check_bsdf``.

    Any other object that has ``ray_intersect``, ``ray_test`` and ``bbox`` will do as well.
    """
    runtime.use()
    with _with_our_errors():
        return Check(**vars(laws.check_shape(shape, quick=quick, seed=seed, only=only)))


def check_emitter(
    emitter: Any,
    *,
    scene: mi.Scene | None = None,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
) -> Check:
    """Check the laws of an emitter; see ``check_bsdf``. A dict may also be of a shape with an emitter.

    ``scene``: the one that a loaded emitter belongs to; else it lights a sphere of radius 1, and what lights
    from a surface does so from a square.
    """
    runtime.use()
    with _with_our_errors():
        found = laws.check_emitter(emitter, scene=scene, quick=quick, seed=seed, only=only)
    return Check(**vars(found))


def check_scene(
    scene: Any, *, quick: bool = False, seed: int = 0, progress: Progress | None = None, **options: Any
) -> SceneCheck:
    """Check every BSDF, shape and emitter of a scene, and look for pixels that are not finite.

    ``scene`` and ``options`` (such as ``integrator`` or ``width``) are those of ``render``; of these, the
    ones count that say what is rendered. Only some of many plugins of one kind are checked. Raises
    ``SceneError`` or ``UsageError`` where the scene does not open.
    """
    from mrt_mitsuba.rendering.api import open_with
    from mrt_mitsuba.rendering.settings import RenderSettings
    from mrt_mitsuba.scene.open import sized

    progress = progress or Progress()
    settings = RenderSettings.of(**options)
    runtime.use(settings.variant)
    source = open_with(scene, settings)

    def each(plugins: Sequence[Any]) -> Iterator[Any]:
        with progress.stage("Laws", len(plugins)) as advance:
            for plugin in plugins:
                yield plugin
                advance(1)

    with sized(source):
        found = laws.check_scene(
            source.scene,
            integrator=source.integrator,
            sensor=source.sensor,
            name=source.name,
            quick=quick,
            seed=seed,
            progress=each,
        )
    return SceneCheck(**vars(found))
