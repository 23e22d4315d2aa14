"""The drawing of the architecture page: packages of the project, and the data that flows between them."""

from __future__ import annotations

from dataclasses import dataclass

HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 820 430" font-family="sans-serif"
  font-size="13" role="img" aria-label="The packages of the project and the data that flows between them">
  <defs>
    <marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">
      <path d="M0 0 L8 4 L0 8 z" fill="#456"/>
    </marker>
    <style>
      .package { fill: #eef3f8; stroke: #9ab; } .part { fill: #fdf3e1; stroke: #cb9; }
      .name { font-weight: bold; } .data { font-style: italic; fill: #456; font-size: 12px; }
      .small { font-size: 11px; fill: #333; }
      .way { stroke: #456; fill: none; marker-end: url(#tip); }
    </style>
  </defs>
  <rect width="820" height="430" fill="#fff"/>"""


@dataclass(frozen=True)
class Box:
    """A package, or a part of one; place and size in pixels."""

    name: str
    x: int
    y: int
    width: int
    height: int
    lines: tuple[str, ...] = ()
    look: str = "package"

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
    """Data that flows from one package to another; ``x`` and ``y`` place the label."""

    path: str
    label: str = ""
    x: int = 0
    y: int = 0

    def svg(self) -> list[str]:
        text = f'  <text class="data" x="{self.x}" y="{self.y}">{self.label}</text>'
        return [f'  <path class="way" d="{self.path}"/>', *([text] if self.label else [])]


BOXES = (
    Box("command/", 20, 20, 150, 76, ("words to options,", "help, exit codes")),
    Box("scene/", 20, 150, 150, 90, ("number, Scene, dict,", "XML or OBJ to a", "Mitsuba scene")),
    Box(
        "plugins/",
        20,
        310,
        150,
        110,
        ("integrator, BSDF,", "shapes, lights;", "whitted/: facts, plan", "and data of kernels"),
    ),
    Box("rendering/", 225, 20, 370, 220),
    Box("settings", 245, 56, 150, 48, ("checked options",), "part"),
    Box("plan", 425, 56, 150, 64, ("kernels, layers, and a", "dataclass for each pass"), "part"),
    Box("shading", 245, 166, 150, 52, ("calls the integrator",), "part"),
    Box("passes, exposing", 425, 166, 150, 52, ("run what the plan says",), "part"),
    Box(
        "adaptive/",
        225,
        310,
        170,
        110,
        ("half and pilot images;", "estimate, allocate,", "denoise; metrics,", "samplers"),
    ),
    Box(
        "filters/",
        425,
        310,
        170,
        110,
        ("edges, depth of field,", "denoising:", "arrays in, arrays out"),
    ),
    Box("sweeps/", 650, 20, 150, 76, ("grids, frames, seeds", "in many processes")),
    Box("files/", 650, 150, 150, 90, ("table of layers,", "PNG and EXR")),
    Box("validation/", 650, 310, 150, 110, ("references, studies,", "comparisons")),
    Box("laws/", 660, 372, 130, 40, (), "part"),
)
WAYS = (
    Way("M170 58 L225 58 L243 74", "options", 176, 52),
    Way("M395 80 L423 80", "RenderSettings", 372, 50),
    Way("M170 190 L217 190 L217 136 L440 136 L440 122", "Source", 172, 184),
    Way("M500 120 L500 164", "Plan", 507, 150),
    Way("M425 184 L397 184", "rays", 399, 179),
    Way("M395 206 L423 206", "radiance", 386, 234),
    Way("M290 218 L290 274 L95 274 L95 308", "calls", 105, 268),
    Way("M460 218 L460 258 L320 258 L320 308", "sums of samples", 328, 252),
    Way("M360 308 L360 280 L482 280 L482 220", "allocation", 366, 294),
    Way("M505 218 L505 308", "pictures", 511, 270),
    Way("M570 308 L570 220", "edges, blur", 576, 292),
    Way("M650 58 L597 58", "jobs", 612, 52),
    Way("M575 194 L648 194", "Result", 605, 188),
    Way("M725 310 L725 242", "reads", 732, 282),
)


def drawing() -> str:
    """The drawing, as SVG."""
    parts = [part.svg() for part in (*BOXES, *WAYS)]
    return "\n".join([HEAD, *(line for lines in parts for line in lines), "</svg>"]) + "\n"
