"""The gallery: one table of pictures, each with the command that makes it."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from mrt_mitsuba import options
from mrt_mitsuba.output import write_png
from mrt_mitsuba.render import render
from mrt_mitsuba.result import Result
from mrt_mitsuba.scenes import NUMBERS, report_scene

SIZE = "width=400 height=300"


@dataclass(frozen=True)
class Entry:
    """``layer``: show this layer in place of the picture, scaled to its largest finite value."""

    name: str
    command: str
    caption: str
    layer: str | None = None


def entries() -> list[Entry]:
    """Scenes first, then what the filters see and do."""
    scenes = [
        Entry(f"scene{n}", f"mrt scene{n} {n} {SIZE}", f"Scene {n}: {report_scene(n).title}.")
        for n in NUMBERS
    ]
    return [
        *scenes,
        Entry(
            "contours_luma",
            f"mrt contours_luma 3 {SIZE} aamode=luma layers=edges,samples focaldist=0",
            "What the luma detector refines in scene 3, dark places above all.",
            "samples.Y",
        ),
        Entry(
            "contours_sobel",
            f"mrt contours_sobel 3 {SIZE} aamode=sobel layers=edges,samples focaldist=0",
            "What the Sobel detector refines: every change of an 8-bit grey.",
            "samples.Y",
        ),
        Entry(
            "contours_geometry",
            f"mrt contours_geometry 3 {SIZE} aamode=geometry layers=edges,samples focaldist=0",
            "What the geometry detector refines: outlines and creases, and no shading.",
            "samples.Y",
        ),
        Entry(
            "height_map",
            f"mrt height_map 3 {SIZE} focaldist=3 focalrange=0.5 layers=blur",
            "The amount of blur in each pixel, 0 to 8: the report's height map.",
            "blur.Y",
        ),
        Entry(
            "blur_report",
            f"mrt blur_report 3 {SIZE} focaldist=3 focalrange=0.5",
            "Depth of field as in the report: seams where the depth jumps.",
        ),
        Entry(
            "blur_corrected",
            f"mrt blur_corrected 3 {SIZE} focaldist=3 focalrange=0.5 dof=corrected",
            "The same without its flaws.",
        ),
        Entry(
            "motion",
            f"mrt motion 3 {SIZE} focaldist=0 motion=0.25,0,-0.25 motionsamples=16",
            "Motion blur: the camera moves while the shutter is open.",
        ),
        Entry(
            "direct",
            f"mrt direct 3 {SIZE} aamode=none aa=2 layers=direct focaldist=0",
            "Direct light only, a layer of the EXR.",
            "direct",
        ),
        Entry(
            "reflection",
            f"mrt reflection 3 {SIZE} aamode=none aa=2 layers=reflection focaldist=0",
            "What the mirror rays add, another layer.",
            "reflection",
        ),
    ]


def build(folder: Path) -> None:
    """Render the gallery into a folder, with a page to include."""
    page = []
    for entry in entries():
        write_png(folder / f"{entry.name}.png", _picture(entry))
        page.append(
            f"## {entry.caption.split(':')[0].rstrip('.')}\n\n{entry.caption}\n\n"
            f"```sh\n{entry.command}\n```\n\n"
            f"```{{image}} _generated/{entry.name}.png\n:alt: {entry.caption}\n```\n"
        )
    (folder / "gallery.inc.md").write_text("\n".join(page))


def _picture(entry: Entry):  # type: ignore[no-untyped-def]
    import numpy as np

    parsed = options.parse(shlex.split(entry.command)[1:])
    scene = parsed.scene if parsed.scene is not None else parsed.scene_number
    result: Result = render(scene, **parsed.render_arguments())
    if entry.layer is None:
        return result.image
    if "." not in entry.layer:
        return np.stack([result.layers[f"{entry.layer}.{channel}"] for channel in "RGB"], axis=-1)
    values = result.layers[entry.layer]
    return np.repeat((values / values[np.isfinite(values)].max())[:, :, None], 3, axis=-1)
