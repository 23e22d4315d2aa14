"""The gallery: sections of pictures, each with the code that makes it, which is run to make it."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass, replace
from pathlib import Path

from mrt_mitsuba.command import options
from mrt_mitsuba.command import render as renderer
from mrt_mitsuba.scene.report import NUMBERS, report_scene

SIZE = "width=400 height=300"


@dataclass(frozen=True)
class Entry:
    """Code, a command of the shell or Python, and the pictures that it writes: name to caption."""

    code: str
    pictures: dict[str, str]
    wide: bool = False  # gets a row to itself

    @property
    def language(self) -> str:
        return "sh" if self.code.startswith("mrt ") else "python"


Section = tuple[str, str, tuple[Entry, ...]]  # title, text, entries


def sections() -> list[Section]:
    """Return all that the gallery shows."""
    return [
        (
            "The report's scenes",
            "As the original has them, numbers included. The PNG holds the values of light, without "
            "the curve that screens expect, as in the original.",
            tuple(_scene(n) for n in NUMBERS if n not in (5, 6, 7, 8)),
        ),
        (
            "Further scenes",
            "The original's scenes 5 to 8 use models that are not free; these are the project's own, in "
            "their place.",
            tuple(_scene(n) for n in (5, 6, 7, 8)),
        ),
        (
            "Contours",
            "What a detector finds gets more samples, the rest keeps one a pixel. Here are the three "
            "detectors in scene 3, and two of them side by side in scene 7, as the report compares them.",
            (CONTOURS, SIDE_BY_SIDE),
        ),
        (
            "Anti-aliasing, enlarged",
            "Five times as large: a sphere and its shadows in scene 3.",
            (ANTIALIASING,),
        ),
        (
            "Depth of field",
            "The height map is the amount of blur, from 0 (black) to 8. With the report's filter, what is "
            "blurred in front ends at a hard rim where it meets something sharp; corrected, it spreads over "
            "it, as behind a lens.",
            (HEIGHT_MAP, *BLUR, BLUR_ENLARGED),
        ),
        (
            "Motion blur",
            "The camera moves while the shutter is open. Eight averaged renders show as eight copies; the "
            "same number of moments spread over the rays of neighbouring pixels does not.",
            MOTION,
        ),
        (
            "Textures",
            "A detail of scene 8: the nearest texel as stored, as in the report, and Mitsuba's way, between "
            "texels and decoded from sRGB.",
            (TEXTURES,),
        ),
        (
            "Layers",
            "What an EXR can hold next to the picture. Direct light and reflection add up to the picture.",
            (LAYERS,),
        ),
        (
            "Any Mitsuba scene",
            "Adaptive sampling over Mitsuba's Cornell box with its path tracer.",
            (CORNELL_BOX,),
        ),
    ]


def _scene(number: int) -> Entry:
    name = f"scene{number}"
    return Entry(f"mrt {name} {number} {SIZE}", {name: f"Scene {number}: {report_scene(number).title}."})


CONTOURS = Entry(
    """
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import filters

first = mrt.render(3, width=400, height=300, aamode="none", aa=1, focaldist=0,
                   layers=["normal", "depth"])
normal = np.stack([first.layers[f"normal.{axis}"] for axis in "XYZ"], axis=-1)

edges = {
    "luma": filters.luma_edges(first.image),
    "sobel": filters.sobel_edges(first.image),
    "geometry": filters.geometry_edges(normal, first.layers["depth.Z"]),
}
for name, found in edges.items():
    filters.save_contours(f"contours_{name}.png", found)
""",
    {
        "contours_luma": "`aamode=luma`: changes of brightness, and everything dark.",
        "contours_sobel": "`aamode=sobel`: every change of an 8-bit grey, smooth gradients included.",
        "contours_geometry": "`aamode=geometry`: outlines and creases, and no shading.",
    },
)
SIDE_BY_SIDE = Entry(
    """
import mrt_mitsuba as mrt
from mrt_mitsuba import filters

image = mrt.render(7, width=400, height=300, aamode="none", aa=1).image
edges = filters.luma_edges(image), filters.sobel_edges(image)
filters.save_contours("contours_scene7.png", *edges)
""",
    {"contours_scene7": "Scene 7: luma at the left, Sobel at the right."},
    wide=True,
)
ANTIALIASING = Entry(
    """
import mrt_mitsuba as mrt
from mrt_mitsuba.output.files import write_png

def enlarged(aamode, aa):
    image = mrt.render(3, width=400, height=300, focaldist=0, aamode=aamode, aa=aa).image
    return image[195:255, 175:255].repeat(5, axis=0).repeat(5, axis=1)

write_png("aa_one.png", enlarged("none", 1))
for aamode in ("none", "luma", "sobel", "geometry"):
    write_png(f"aa_{aamode}.png", enlarged(aamode, 4))
""",
    {
        "aa_one": "One sample a pixel.",
        "aa_none": "`aamode=none`: sixteen samples in every pixel.",
        "aa_luma": "`aamode=luma`.",
        "aa_sobel": "`aamode=sobel`.",
        "aa_geometry": "`aamode=geometry`: outlines are smooth, shadows are not.",
    },
)
HEIGHT_MAP = Entry(
    """
import mrt_mitsuba as mrt
from mrt_mitsuba.output.files import write_png

result = mrt.render(3, width=400, height=300, focaldist=2.8, focalrange=0.3,
                    layers=["blur"])
write_png("height_map.png", result.layers["blur.Y"][:, :, None].repeat(3, axis=2) / 8)
""",
    {"height_map": "The height map of scene 3, the nearest sphere in focus."},
)
BLUR = tuple(
    Entry(f"mrt {name} {scene} {SIZE} {focus}", {name: caption})
    for name, scene, focus, caption in (
        ("blur_report", 3, "focaldist=2.8 focalrange=0.3", "Scene 3 with the report's filter."),
        ("blur_corrected", 3, "focaldist=2.8 focalrange=0.3 dof=corrected", "Scene 3, corrected."),
        (
            "blur_scene4",
            4,
            "focaldist=6 focalrange=0.5 dof=corrected",
            "Scene 4, the far end in focus, corrected.",
        ),
    )
)
BLUR_ENLARGED = Entry(
    """
import mrt_mitsuba as mrt
from mrt_mitsuba.output.files import write_png

for dof in ("report", "corrected"):
    result = mrt.render(4, width=400, height=300, focaldist=6, focalrange=0.5, dof=dof)
    part = result.image[220:280, 300:380].repeat(5, axis=0).repeat(5, axis=1)
    write_png(f"blur_enlarged_{dof}.png", part)
""",
    {
        "blur_enlarged_report": "A corner of scene 4, the report's filter: see the rim of the near sphere.",
        "blur_enlarged_corrected": "The same, corrected.",
    },
)
MOVED = "focaldist=0 aa=2 motion=0.25,0,-0.25 motionsamples=8"
MOTION = (
    Entry(f"mrt motion_frames 3 {SIZE} {MOVED}", {"motion_frames": "Eight renders, as in the report."}),
    Entry(
        f"mrt motion_stratified 3 {SIZE} {MOVED} motionmode=stratified",
        {"motion_stratified": "Eight moments for each pixel, others for the next one."},
    ),
)
TEXTURES = Entry(
    """
from dataclasses import replace

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.report import report_scene

scene = report_scene(8)
near = replace(scene.camera, position=(0.7, 0.75, 1.0), target=(0, 0.55, 0.2), hfov=30)
for texturing in ("report", "standard"):
    view = replace(scene, camera=near, texturing=texturing)
    result = mrt.render(view, width=400, height=300)
    result.save(f"texture_{texturing}.png", tonemap="srgb")
""",
    {
        "texture_report": "`texturing=report`, as `mrt_texture` reads a picture.",
        "texture_standard": "`texturing=standard`, as Mitsuba's `bitmap` does.",
    },
)
LAYERS = Entry(
    """
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.output.files import write_png

names = ["depth", "normal", "albedo", "direct", "reflection", "bounces"]
result = mrt.render(3, width=400, height=300, aamode="none", aa=2, focaldist=0,
                    layers=names)

def layer(name, channels):
    return np.stack([result.layers[f"{name}.{channel}"] for channel in channels], axis=-1)

write_png("layer_depth.png", layer("depth", "ZZZ") / 8)
write_png("layer_normal.png", 0.5 + 0.5 * layer("normal", "XYZ"))
write_png("layer_albedo.png", layer("albedo", "RGB"))
write_png("layer_direct.png", layer("direct", "RGB"))
write_png("layer_reflection.png", layer("reflection", "RGB"))
write_png("layer_bounces.png", layer("bounces", "YYY") / 5)
""",
    {
        "layer_depth": "`depth`: distance of the first hit; white is 8.",
        "layer_normal": "`normal`: −1 to 1 as 0 to 1.",
        "layer_albedo": "`albedo`: diffuse colour.",
        "layer_direct": "`direct`: light of the lamps alone.",
        "layer_reflection": "`reflection`: what the mirror rays add.",
        "layer_bounces": "`bounces`: mirror rays; white is 5.",
    },
)
CORNELL_BOX = Entry(
    """
import mitsuba as mi

import mrt_mitsuba as mrt

mrt.register()
box = mi.load_dict(mi.cornell_box())
result = mrt.render(box, integrator="path", spp=64, aa=2, aamode="geometry")
result.save("cornell_box.png", tonemap="srgb")
""",
    {"cornell_box": "Outlines got four times the rays."},
)


def build(folder: Path) -> None:
    """Make all pictures in a folder, and a page to include."""
    page = []
    for title, text, entries in sections():
        page += [f"## {title}", text, ":::::{container} pictures"]
        for entry in entries:
            make(entry, folder)
            page += [_figure(name, caption, entry) for name, caption in entry.pictures.items()]
        page.append(":::::")
        page += [f"```python\n{e.code.strip()}\n```" for e in entries if e.language == "python"]
    (folder / "gallery.inc.md").write_text("\n\n".join(page) + "\n")


def make(entry: Entry, folder: Path) -> None:
    """Run the code of an entry in a folder."""
    before = os.getcwd()
    os.chdir(folder)
    try:
        if entry.language == "python":
            exec(compile(entry.code, next(iter(entry.pictures)), "exec"), {})
        else:
            renderer.run(replace(command(entry), format="png", quiet=True))
    finally:
        os.chdir(before)


def command(entry: Entry) -> options.Options:
    """The options of an entry's command."""
    return options.parse(shlex.split(entry.code)[1:])


def _figure(name: str, caption: str, entry: Entry) -> str:
    lines = [f"::::{{figure}} _generated/{name}.png", f":alt: {caption.replace('`', '')}"]
    lines += [":figclass: wide"] if entry.wide else []
    lines += ["", caption]
    lines += ["", f"```sh\n{entry.code}\n```"] if entry.language == "sh" else []
    return "\n".join([*lines, "::::"])
