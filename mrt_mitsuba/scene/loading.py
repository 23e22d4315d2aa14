"""Loading dicts and XML files with Mitsuba, after checking what they would make it do.

Mitsuba takes a plugin from ``plugins/NAME.so`` in the first folder of its file resolver that has one, and the
folders of a scene and of the process come before its own: a file that lies there would run as native code.
Here Mitsuba's own folder comes first, and a plugin that only another folder has is refused; the other folders
serve for data. Files that are read without an end (pipes, devices) and elements nested so deep that Mitsuba's
parser would end the process are refused as well.

Objects are made one after the other. In parallel, Mitsuba makes Python objects inside each other, to the
limit of the stack, and Dr.Jit's messages may wait for each other for ever; one by one takes no longer.
``mrt_mitsuba.mitsuba_changes`` makes that the default of Mitsuba's own loaders for our plugins.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping

import mitsuba as mi

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.interrupts import held
from mrt_mitsuba.machine import Budget
from mrt_mitsuba.mitsuba_changes import mitsuba_first, mitsuba_home, two_threads
from mrt_mitsuba.options import Values
from mrt_mitsuba.scene.files import DEEPEST, elements, picture_size, require_file

MOST_SAMPLES = 2**24  # of a pixel; some samplers divide by none, or never end at 2^31
_PICTURES = ("mrt_texture", "bitmap", "envmap")  # plugins that read one

# A traceback, all indented except its first line, with the type of this project's error; and the place in
# Mitsuba's own sources where an error was raised
_ORIGIN = re.compile(
    r"Traceback \(most recent call last\):\n(?:[ \t][^\n]*\n|\n)*(?:\w*ParameterError: )?"
    r"|\[\w+\.(?:cpp|h):\d+\] "
)


def load_dict(
    scene: Values, name: str = "the dict", budget: Budget | None = None, *, merge: bool = True
) -> mi.Object:
    """Load a Mitsuba dict: a scene, or any other object.

    ``merge``: make one of meshes of the same material, as Mitsuba does, which leaves them in any order.
    Raises ``SceneError`` that calls it ``name``, and ``UsageError`` for a texture too large for the budget.
    """
    budget = budget or Budget.of(None)
    with _loading(name):
        _check_dict(scene, budget.inputs)
        state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), scene)
        _check_nodes(state.nodes, budget)
        return _instantiate(state, merge)


def load_file(
    path: str, parameters: Values, budget: Budget | None = None, *, as_text: bool = False
) -> tuple[mi.Object | str, Mapping[str, str]]:
    """The scene of an XML file, and its ``$parameters`` with the values given, or the defaults.

    ``as_text``: return it as XML, with includes and parameters filled in, and files by their whole path.
    Raises ``SceneError``, and ``UsageError`` for another kind of file or a texture too large for the budget.
    """
    require_file(path)
    if not path.lower().endswith(".xml"):
        raise UsageError(f"cannot read {path}: a scene file ends in .xml or .obj")
    budget = budget or Budget.of(None)
    given = {key: str(value) for key, value in parameters.items()}
    with _loading(path, os.path.dirname(path) or "."):
        values = _check_xml(path, given, budget.inputs)
        state = mi.parser.parse_file(mi.parser.ParserConfig(mi.variant()), path, **given)
        _check_nodes(state.nodes, budget)
        if not as_text:
            return _instantiate(state), values
        for node in state.nodes:
            if isinstance(node.props.get("filename", None), str):
                node.props["filename"] = os.path.abspath(_resolved(node.props["filename"]))
        return mi.parser.write_string(state), values


# ---------------------------------------------- Mitsuba's parser ---------------------------------------


def _check_nodes(nodes: Iterable[mi.parser.SceneNode], budget: Budget) -> None:
    """Look at all that Mitsuba would load for what it has parsed."""
    mitsuba_first()  # a <path> of the file puts its folder before
    for node in nodes:
        kind = node.props.plugin_name()
        filename = node.props.get("filename", None)
        _check_plugin(kind)
        samples = node.props.get("sample_count", 1)
        if isinstance(samples, int) and not 1 <= samples <= MOST_SAMPLES:
            raise RuntimeError(f"{kind}: sample_count is {samples}; give 1 to {MOST_SAMPLES}")
        if isinstance(filename, str):
            file = _check_data(filename, budget.inputs)
            size = picture_size(file) if kind in _PICTURES else None
            if size:
                budget.take_texture(file, *size, around=kind == "envmap")


def _instantiate(state: mi.parser.ParserState, merge: bool = True) -> mi.Object:
    config = mi.parser.ParserConfig(mi.variant())
    config.parallel = False
    config.merge_meshes = merge
    mi.parser.transform_all(config, state)
    with two_threads, held():  # an interrupt would leave plugins half made, and later renders would crash
        return mi.parser.instantiate(config, state)


@contextlib.contextmanager
def _loading(name: str, folder: str | None = None) -> Iterator[None]:
    """Take plugins from Mitsuba's own folder within the block, and data from ``folder`` as well; turn a
    ``RuntimeError``, of Mitsuba or of the checks below, into a ``SceneError`` that says what was loaded."""
    before = mi.file_resolver()
    mitsuba_first(folder)
    try:
        yield
    except RuntimeError as error:
        text = " ".join(_ORIGIN.sub("", str(error)).split())
        raise SceneError(f"cannot load {name}: {text}") from error
    finally:
        mi.set_file_resolver(before)


def _resolved(path: str) -> str:
    return str(mi.file_resolver().resolve(path))


# ---------------------------------------------- Checks -------------------------------------------------


def _check_plugin(plugin: str) -> None:
    """Refuse a native plugin outside Mitsuba's folder. Mitsuba itself reports unknown names."""
    file = os.path.join("plugins", f"{plugin}.so")
    known = "/" not in plugin and os.path.isfile(os.path.join(mitsuba_home(), file))
    if plugin != "scene" and not known and os.path.exists(_resolved(file)):  # "scene" is never looked up
        raise RuntimeError(
            f"the plugin {plugin!r} is {_resolved(file)}, native code that is not Mitsuba's; move it away "
            f"or, if you trust it, into {mitsuba_home()}/plugins"
        )


def _check_data(filename: str, inputs: set[str]) -> str:
    """Refuse a pipe, a device or a folder; otherwise note the path and return it. Mitsuba itself reports a
    missing file."""
    path = _resolved(filename) if filename else ""
    if os.path.exists(path):
        require_file(path)
    inputs.add(path)
    return path


def _check_dict(node: Values, inputs: set[str], place: str = "", depth: int = 1) -> None:
    """Look at every entry. None, cycles and depth would end the process."""
    if depth > DEEPEST:
        raise RuntimeError(f"it is nested more than {DEEPEST} levels deep")
    for key, value in node.items():
        if isinstance(value, dict):
            _check_dict(value, inputs, f"{place}{key}.", depth + 1)
        elif value is None:
            raise RuntimeError(f"{place}{key} is None; give it a value, or leave it out")
        elif key == "type" and not isinstance(value, str):
            raise RuntimeError(f"{place}type is {value!r}; give the name of a plugin")
        elif key == "type":
            _check_plugin(value)
        elif key == "filename" and isinstance(value, str):
            _check_data(value, inputs)


def _check_xml(path: str, parameters: Mapping[str, str], inputs: set[str]) -> Mapping[str, str]:
    """Look at an XML file and those that it includes before Mitsuba opens them; return its parameters."""
    values = dict(parameters)
    files = [path]
    inputs.add(path)
    for including in files:  # which grows
        for tag, attributes in elements(including):
            if tag == "default":
                values.setdefault(attributes.get("name", ""), attributes.get("value", ""))
                continue
            filename = attributes.get("value" if tag == "path" else "filename", "")
            for name in sorted(values, key=len, reverse=True):  # the longest first, as Mitsuba does
                filename = filename.replace(f"${name}", values[name]) if name else filename
            if tag == "path":
                mitsuba_first(_resolved(filename))
            elif filename:
                file = _check_data(filename, inputs)
                if tag == "include" and os.path.isfile(file) and file not in files:
                    files.append(file)
    return values
