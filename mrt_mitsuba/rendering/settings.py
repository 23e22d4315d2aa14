"""The options of ``mrt.render``: ``RenderSettings`` holds and checks them, also for the command, which adds
its own; ``RenderOptions`` has their types for editors.

A new option is a field, a type in ``RenderOptions`` and a parameter of ``render``.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from mrt_mitsuba.adaptive.target import METRIC_NAMES, Goal, Target
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.files.layers import LAYERS
from mrt_mitsuba.options import (
    ANGLE,
    ANYTHING,
    BYTES,
    FUNCTION,
    NAME,
    NUMBER,
    PARAMETERS,
    SWITCH,
    TARGET,
    VECTOR,
    check,
    choice,
    instance,
    integer,
    option,
    subset,
    table,
)
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.scene.model import CONVENTION, FRESNEL, MODEL_OPTIONS, SIDE, SIZE

if TYPE_CHECKING:
    from mrt_mitsuba.adaptive.error import RoundPicture

Convention = Literal["report", "standard"]
Lattice = Literal["report", "centered", "film"]
#: The edge detectors as ``aamode`` names them: ``filters.<name>_edges``, and the layers that each reads, in
#: the order of its arguments; those of the picture can distinguish noise from edges
DETECTORS = {"luma": ("image",), "sobel": ("image",), "geometry": ("normal", "depth")}
# Defaults of the report's scenes
AA = 4
AAMODE = "sobel"
FILM = "film"  # the lattice of a scene's film
NOISE = "noise"  # the aamode that allocates samples by variance
MIN_SPP = 16  # samples per pixel from which the variance is estimated
MAX_SPP = 4096  # mean samples per pixel, where a target alone would ask for more
LARGEST_AA = 64  # 4096 samples per pixel; beyond, float32 sums lose more than more samples gain


class RenderOptions(TypedDict, total=False):
    """The options of ``render`` as type checkers see them where a function takes ``**options``."""

    width: int | None
    height: int | None
    aa: int | None
    aamode: Literal["none", "luma", "sobel", "geometry", "noise"] | None
    target: Target | float | str | Sequence[float] | None
    metric: Literal["linear", "relative", "display"] | None
    denoise: bool
    maxspp: int | None
    maxseconds: float | None
    lattice: Lattice | None
    fresnel: Literal["schlick", "dielectric"] | None
    focaldist: float | None
    focalrange: float | None
    dof: Literal["report", "corrected"]
    layers: Sequence[str] | str
    motion: Sequence[float] | None
    motionsamples: int
    convention: Convention
    camera: Sequence[float] | None
    up: Sequence[float] | None
    fov: float | None
    variant: str | None
    memory: int | str | None
    seed: int
    integrator: Any
    sensor: int
    on_round: Callable[[RoundPicture], object] | None
    spp: int | None
    count_rays: bool
    params: Mapping[str, Any] | None
    progress: Progress | None


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """The options of a render, each checked when it is given. None: the scene or the machine decides.

    Raises ``UsageError`` for a value of the wrong type or range.
    """

    width: int | None = option(None, SIDE, "image width in pixels, up to 65536", str(SIZE[0]))
    height: int | None = option(None, SIDE, "image height in pixels, up to 65536", str(SIZE[1]))
    aa: int | None = option(
        None, integer(1, LARGEST_AA), f"anti-aliasing: aa x aa samples per pixel, up to {LARGEST_AA}", str(AA)
    )
    aamode: str | None = option(
        None,
        choice("none", *DETECTORS, NOISE),
        f"refine all pixels, only edges by a detector ({', '.join(DETECTORS)}), or noisy pixels",
        AAMODE,
    )
    target: Target | tuple[float, ...] | None = option(
        None,
        TARGET,
        "error to render to: an RMSE, or a percentage such as 2% of the picture's mean luminance or, with "
        "metric=display, of white; "
        "OBJ file: what the camera looks at",
        "none",
    )
    metric: str | None = option(
        None,
        choice(*METRIC_NAMES),
        "error of target and aamode=noise: RMSE of linear values, relative to them, or of sRGB in [0, 1]",
        METRIC_NAMES[0],
    )
    denoise: bool = option(
        False, SWITCH, "mix the picture with its denoised version where that errs less; with target or spp"
    )
    maxspp: int | None = option(
        None, integer(MIN_SPP, 2**24), "largest mean number of samples per pixel, with a target", str(MAX_SPP)
    )
    maxseconds: float | None = option(None, NUMBER, "seconds to spend at most, with a target", "none")
    lattice: str | None = option(
        None,
        choice("report", "centered", FILM),
        "samples from the pixel centre on, around it, or by the rules of a scene's film",
        "report, own scenes: film",
    )
    fresnel: str | None = option(None, FRESNEL, "reflectance formula", "schlick")
    focaldist: float | None = option(
        None, NUMBER, "distance in focus, from the camera; 0: no depth of field", "from the scene"
    )
    focalrange: float | None = option(
        None, NUMBER, "half-width of the sharp zone around it", "from the scene"
    )
    dof: str = option(
        "report", choice("report", "corrected"), "depth of field as in the report, or without its flaws"
    )
    layers: tuple[str, ...] = option(
        (), subset(LAYERS), f"more EXR layers: all, or some of {', '.join(LAYERS)}", "none"
    )
    motion: tuple[float, ...] | None = option(
        None, VECTOR._replace(form="DX,DY,DZ"), "motion blur: how far the camera moves", "none"
    )
    motionsamples: int = option(16, integer(1, 65536), "moments at which motion blur sees the scene")
    convention: str = option("report", CONVENTION, "MTL files: Ni is the roughness, or the IOR")
    camera: tuple[float, ...] | None = option(
        None, VECTOR, "OBJ file: where the camera is", "by the model's size"
    )
    up: tuple[float, ...] | None = option(None, VECTOR, "OBJ file: what is up", "0,1,0")
    fov: float | None = option(None, ANGLE, "OBJ file: horizontal field of view", "60")
    variant: str | None = option(None, NAME, "Mitsuba variant", "llvm_ad_rgb, without LLVM scalar_rgb")
    memory: int | None = option(
        None, BYTES, "memory to stay within: a number, with K, M, G or T for a unit", "half of what is free"
    )
    seed: int = option(0, integer(0, 2**32 - 1), "seed where anything is random")
    integrator: Any = option(
        None,
        ANYTHING._replace(form="NAME"),
        "name, dict or instance of an integrator; one for whole images, such as ptracer, has no layers, "
        "edges, motion or depth of field",
        "the scene's own",
    )
    sensor: int = option(0, integer(0, 65535), "number of the sensor, in a scene that has several")
    on_round: Callable[[RoundPicture], object] | None = option(
        None, FUNCTION, "called after each round with a RoundPicture; stops the render by returning False"
    )
    spp: int | None = option(
        None,
        integer(1, 65536),
        "samples per lattice point, where the integrator is random; aamode=noise: mean per pixel",
        "1",
    )
    count_rays: bool = option(False, SWITCH._replace(form=""), "count mirror and shadow rays")
    params: dict[str, Any] | None = option(
        None, PARAMETERS, "values for the $names that an XML file declares, and by keys of mi.traverse"
    )
    progress: Progress | None = option(
        None,
        instance(Progress, "a rendering.progress.Progress"),
        "receives the plan and the progress of its stages",
    )

    def __post_init__(self) -> None:
        values = vars(self)
        for field in dataclasses.fields(self):
            if field.metadata and values[field.name] is not field.default:
                values[field.name] = check(field.name, field.metadata["kind"], values[field.name])

    @classmethod
    def of(cls, **options: object) -> RenderSettings:
        """Make settings of the options that a user gives; raise ``TypeError`` for an unknown one."""
        for name in options.keys() - cls.__dataclass_fields__.keys():
            close = difflib.get_close_matches(name, cls.__dataclass_fields__, 1)
            raise TypeError(
                f"{name!r} is not an option of render" + "".join(f": did you mean {c}?" for c in close)
            )
        return cls(**options)  # type: ignore[arg-type]  # which ``__post_init__`` checks

    @property
    def error(self) -> Target | None:
        """Error target of the render, None without one."""
        return self.target if isinstance(self.target, Target) else None

    def goal(self, stated: Goal | None = None) -> Goal | None:
        """Return the goal of an adaptive render; None for a render without rounds.

        ``stated``: the goal of the scene's integrator, used where no option sets samples per pixel. Raises
        ``UsageError`` for too few samples.
        """
        mean = self.spp or 1
        further = (self.maxseconds, self.metric or METRIC_NAMES[0], self.denoise)
        if self.error is not None:
            return Goal(self.error, self.maxspp or MAX_SPP, *further)
        if self.aamode == NOISE or (self.denoise and self.spp is not None and self.aamode is None):
            if mean < MIN_SPP:
                raise UsageError(
                    f"aamode=noise: give the mean of a pixel's samples as spp, {MIN_SPP} or more, or a target"
                )
            return Goal(None, min(mean, self.maxspp or mean), *further)
        if stated is None or self.aamode is not None or self.spp is not None:
            return None
        seconds = stated.max_seconds if self.maxseconds is None else self.maxseconds
        denoise = self.denoise or stated.denoise
        return Goal(
            stated.target, self.maxspp or stated.max_spp, seconds, self.metric or stated.metric, denoise
        )

    def model(self) -> dict[str, Any]:
        """Return the options given for a model and its view, as ``obj.obj_scene`` takes them."""
        names = [name for name in MODEL_OPTIONS if name != "target" or self.error is None]
        given = {name: getattr(self, name) for name in names}
        return {name: value for name, value in given.items() if value is not None}


#: The options of a render by name, without those that only Python can give
TABLE = table(RenderSettings)
