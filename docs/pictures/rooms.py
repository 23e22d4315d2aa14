"""The drawing of the architecture page: rooms of the project, and the data that goes from one to another."""

from __future__ import annotations

from dataclasses import dataclass

HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 820 430" font-family="sans-serif"
  font-size="13" role="img" aria-label="The rooms of the project and the way of data through them">
  <defs>
    <marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">
      <path d="M0 0 L8 4 L0 8 z" fill="#456"/>
    </marker>
    <style>
      .room { fill: #eef3f8; stroke: #9ab; } .part { fill: #fdf3e1; stroke: #cb9; }
      .name { font-weight: bold; } .data { font-style: italic; fill: #456; font-size: 12px; }
      .small { font-size: 11px; fill: #333; }
      .way { stroke: #456; fill: none; marker-end: url(#tip); }
    </style>
  </defs>
  <rect width="820" height="430" fill="#fff"/>"""


@dataclass(frozen=True)
class Box:
    """A room, or a part of one; place and size in pixels."""

    name: str
    x: int
    y: int
    width: int
    height: int
    lines: tuple[str, ...] = ()
    look: str = "room"

    def svg(self) -> list[str]:
        frame = f'x="{self.x}" y="{self.y}" width="{self.width}" height="{self.height}" rx="6"'
        texts = [
            f'  <text class="small" x="{self.x + 10}" y="{self.y + 38 + 16 * row}">{line}</text>'
            for row, line in enumerate(self.lines)
        ]
        title = f'  <text class="name" x="{self.x + 10}" y="{self.y + 20}">{self.name}</text>'
        return [f'  <rect class="{self.look}" {frame}/>', title, *texts]


@dataclass(frozen=True)
class Way:
    """What goes from one room to another; the label begins at a place."""

    path: str
    label: str = ""
    x: int = 0
    y: int = 0

    def svg(self) -> list[str]:
        text = f'  <text class="data" x="{self.x}" y="{self.y}">{self.label}</text>'
        return [f'  <path class="way" d="{self.path}"/>', *([text] if self.label else [])]


BOXES = (
    Box("command/", 20, 20, 150, 80, ("words to options,", "banner, exit codes")),
    Box("scene/", 20, 160, 150, 90, ("numbers, Scene, dict,", "XML, OBJ to a Mitsuba", "scene")),
    Box("rays/", 20, 320, 150, 90, ("where, when and with", "which random numbers;", "canvases of films")),
    Box("rendering/", 235, 20, 350, 250),
    Box("settings", 255, 56, 140, 50, ("checked options",), "part"),
    Box("plan", 425, 106, 140, 64, ("kernels, layers, and a", "dataclass for each pass"), "part"),
    Box("passes, exposing", 425, 200, 140, 52, ("run what the plan says",), "part"),
    Box("rounds, noise", 255, 130, 140, 52, ("where rays go, error",), "part"),
    Box("shading", 255, 206, 140, 46, ("calls the integrator",), "part"),
    Box(
        "plugins/",
        235,
        320,
        160,
        90,
        ("integrator, BSDF, shapes,", "lights; facts and plan", "of their kernels"),
    ),
    Box(
        "filters/",
        425,
        320,
        160,
        90,
        ("edges, depth of field,", "contours: arrays in,", "arrays out"),
    ),
    Box("sweeps/", 650, 20, 150, 80, ("grids, frames and tiles", "on many processes")),
    Box("output/", 650, 160, 150, 90, ("table of layers,", "PNG and EXR")),
    Box(
        "validation/",
        650,
        320,
        150,
        90,
        ("oracles, checks, studies,", "figures: judge all of it", "by its public names"),
    ),
)
WAYS = (
    Way("M170 60 L253 76", "options", 176, 54),
    Way("M395 84 L440 84 L480 104", "RenderSettings", 425, 76),
    Way("M170 190 L200 190 L200 118 L423 118", "Source", 152, 140),
    Way("M495 170 L495 198", "Plan", 502, 189),
    Way("M425 214 L397 172"),
    Way("M425 232 L397 232"),
    Way("M95 318 L95 290 L480 290 L480 254", "starts, canvases", 105, 284),
    Way("M290 252 L290 318", "rays", 296, 308),
    Way("M340 318 L340 254", "radiance", 346, 308),
    Way("M520 254 L520 318", "pictures", 468, 308),
    Way("M550 318 L550 254", "edges, blur", 556, 308),
    Way("M650 60 L587 60", "jobs", 604, 52),
    Way("M565 226 L648 208", "Result", 596, 206),
    Way("M725 318 L725 252", "reads", 732, 290),
)


def drawing() -> str:
    """The drawing, as SVG."""
    parts = [part.svg() for part in (*BOXES, *WAYS)]
    return "\n".join([HEAD, *(line for lines in parts for line in lines), "</svg>"]) + "\n"
