"""Sphinx configuration: ``make docs`` builds the site, with its pictures and numbers computed on the way."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import mrt_mitsuba  # before mitsuba: it chooses the LLVM library
from mrt_mitsuba.machine import usable_cores
from mrt_mitsuba.runtime import versions

HERE = Path(__file__).parent
os.environ["PYTHONPATH"] = os.pathsep.join(  # of the pages' kernels, which import the worked example
    path for path in (str(HERE / "examples"), os.environ.get("PYTHONPATH")) if path
)

project = "mrt-mitsuba"
author = "mrt-mitsuba contributors"
release = mrt_mitsuba.__version__
built = ", ".join(f"{name} {version}" for name, version in versions().items())
copyright = (  # at the foot of every page
    f"{author}. Results of code were measured when this page was built: {built}, {usable_cores()} cores, "
    f"{platform.machine()}. Figures in the text are from version 0.1 with Mitsuba 3.9.1 on two cores of an "
    "AMD EPYC."
)
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 2  # links to headings, as in own_scenes.md
exclude_patterns = ["_build", "_generated/*.inc.md", "examples", "jupyter_execute"]
html_theme = "furo"
html_title = "mrt-mitsuba"
html_use_index = html_domain_indices = False  # there is a search
html_static_path = ["_static"]
html_css_files = ["site.css"]
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 1200  # seconds a cell: a busy machine fails nothing
nb_merge_streams = True
nb_render_markdown_format = "myst"  # with tables
nb_output_stderr = "remove"  # bars of progress


def generate(app: object) -> None:
    """Make the tables of pages from those of the program."""
    mrt_mitsuba.register()  # plugin classes derive from a variant's classes, so autodoc needs one
    folder = HERE / "_generated"
    folder.mkdir(exist_ok=True)
    (folder / "options.inc.md").write_text(options_list())
    (folder / "layers.inc.md").write_text(layers_table())


def layers_table() -> str:
    """Return the layers that can be asked for, as a table."""
    from mrt_mitsuba.files import LAYERS

    rows = [
        f"| `{layer.name}` | {layer.letters} | {layer.doc} | {layer.source} |" for layer in LAYERS.values()
    ]
    return "\n".join(["| layer | channels | what it holds | how |", "|---|---|---|---|", *rows])


def options_list() -> str:
    """Return the options of the command as a list."""
    from mrt_mitsuba.command import options

    lines = []
    for name, field in options.TABLE.items():
        form, text = field.metadata["kind"].form, field.metadata["help"]
        default = field.metadata["shown"] or field.default
        lines += [f"`{name}={form}`", f": {text[0].upper()}{text[1:]}. Default: {default}.", ""]
    return "\n".join(lines)


def mathml(display: bool):  # type: ignore[no-untyped-def]
    """Write formulas as MathML, which browsers draw by themselves: the site needs no script from
    elsewhere."""
    from docutils.nodes import SkipNode
    from latex2mathml.converter import convert

    def visit(translator, node):  # type: ignore[no-untyped-def]
        translator.body.append(convert(node.astext(), display="block" if display else "inline"))
        raise SkipNode

    return visit


def setup(app: object) -> None:
    app.add_html_math_renderer("mathml", (mathml(False), None), (mathml(True), None))  # type: ignore[attr-defined]
    app.connect("builder-inited", generate)  # type: ignore[attr-defined]
