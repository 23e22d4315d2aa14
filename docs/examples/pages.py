"""What pages of the documentation share: pictures, plots and tables."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from mrt_mitsuba.files import to_8bit
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation.laws import bsdf, emitter, shape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Options of a picture on a page, without bars of progress
SIZE = {"width": 400, "height": 300, "progress": Progress()}

#: Where pictures of the original program are
ORIGINALS = Path(__file__).parents[2] / "tests" / "regression" / "data"

#: Whether the plots of answers are made from few renders, as tests do
QUICK = False


def show(*pictures: np.ndarray, columns: int = 3) -> Image.Image:
    """Pictures [H, W, 3] of one size in rows, in sRGB."""
    starts = range(0, len(pictures), columns)
    rows = [np.hstack(pictures[start : start + columns]) for start in starts]
    return Image.fromarray(
        to_8bit(np.vstack(rows).astype(np.float32), "srgb")
    )


def grey(values: np.ndarray) -> np.ndarray:
    """A map [H, W] as a picture [H, W, 3]."""
    return np.repeat(values[..., None], 3, axis=2)


def enlarged(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """A fifth of a picture five times as large, from (x, y), 0 to 1."""
    height, width = image.shape[:2]
    part = image[int(y * height) :, int(x * width) :]
    return (
        part[: height // 5, : width // 5].repeat(5, axis=0).repeat(5, axis=1)
    )


class Html(str):
    """Text that a page shows as HTML."""

    def _repr_html_(self) -> str:
        return str(self)


def plots(*figures: Figure, width: str = "18rem") -> Html:
    """Plots next to each other, as many as there is room for."""
    images = []
    for figure in figures:
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=160, facecolor="white")
        data = base64.b64encode(file.getvalue()).decode()
        name = figure.axes[0].get_title(loc="left")
        url = f"data:image/png;base64,{data}"
        images.append(f'<img alt="{name}" src="{url}">')
    style = f"--plot: {width}"
    return Html(f'<div class="plots" style="{style}">{"".join(images)}</div>')


def animation(path: str) -> Html:
    """Show a GIF."""
    data = base64.b64encode(Path(path).read_bytes()).decode()
    return Html(f'<img alt="animation" src="data:image/gif;base64,{data}">')


class Markdown(str):
    """Text that a page shows as Markdown."""

    def _repr_markdown_(self) -> str:
        return str(self)


def table(rows: Sequence[Mapping[str, Any]]) -> Markdown:
    """Rows with the same keys as a table."""

    def cells(values: Iterable[Any]) -> str:
        shown = (
            f"{value:.3g}"
            if isinstance(value, float)
            else ""
            if value is None
            else value
            for value in values
        )
        return f"| {' | '.join(map(str, shown))} |"

    names = list(rows[0])
    return Markdown(
        "\n".join(
            [
                cells(names),
                "|---" * len(names) + "|",
                *(cells(row.values()) for row in rows),
            ]
        )
    )


#: The laws of plugins, by kind and name
LAWS = {"BSDF": bsdf.LAWS, "shape": shape.LAWS, "emitter": emitter.LAWS}


def laws() -> list[dict[str, str]]:
    """A row for each law, which its docstring states, in Markdown."""
    rows = []
    for kind, by_name in LAWS.items():
        for law in by_name.values():
            words = law.states.replace("``", "`").replace("|", "\\|")
            rows.append(
                {"plugin": kind, "law": f"`{law.name}`", "states": words}
            )
    return rows


def faults() -> list[dict[str, str]]:
    """A row for each fault, with the least sizes that its law finds."""
    rows = []
    for kind, by_name in LAWS.items():
        for fault in (x for law in by_name.values() for x in law.faults):
            what = {"plugin": kind, "law": f"`{fault.law}`"}
            sizes = {"quick": fault.quick, "full": fault.full}
            sizes = {
                name: f"{size:.1g}".replace("inf", "not found")
                for name, size in sizes.items()
            }
            rows.append({**what, "fault": fault.what, **sizes})
    return rows
