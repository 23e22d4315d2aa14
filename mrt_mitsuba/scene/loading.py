"""Loading dicts and XML files with Mitsuba, after checking what they would make it do.

Mitsuba takes a plugin from ``plugins/NAME.so`` in the first folder of its file resolver that has one, and the
folders of a scene and of the process come before its own: a file that lies there would run as native code.
Here Mitsuba's own folder comes first, and a plugin that only another folder has is refused; the other folders
serve for data. Files that are read without an end (pipes, devices) are refused as well, and dicts for which
Mitsuba 3.9 would end the process.

Objects are made one after the other. In parallel, Mitsuba makes Python objects inside each other, to the
limit of the stack, and Dr.Jit's messages may deadlock; loading them one by one takes no longer.
``mrt_mitsuba.mitsuba_changes`` makes that the default of Mitsuba's own loaders for our plugins.
"""

from __future__ import annotations

import contextlib
import difflib
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.errors import SceneError, UsageError, one_line
from mrt_mitsuba.interrupts import defer_signals
from mrt_mitsuba.mitsuba_changes import mitsuba_first, mitsuba_home
from mrt_mitsuba.options import Values

MAX_DEPTH = 256  # maximum levels of nesting of a dict; Mitsuba overflows its stack from some thousands on
MAX_SAMPLE_COUNT = 2**24  # maximum spp; some samplers divide by zero at 0, or never end at 2^31

# A traceback, all indented except its first line, with the type of this project's error; and the place in
# Mitsuba's own sources where an error was raised
_ORIGIN = re.compile(
    r"Traceback \(most recent call last\):\n(?:[ \t][^\n]*\n|\n)*(?:\w*ParameterError: )?"
    r"|\[\w+\.(?:cpp|h):\d+\] "
)


def load_dict(
    scene: Values,
    name: str = "the dict",
    inputs: set[str] | None = None,
    *,
    merge: bool = True,
    keys: Values | None = None,
) -> mi.Object:
    """Load a Mitsuba dict: a scene, or any other object.

    ``merge``: make one of meshes of the same material, as Mitsuba does, which leaves them in any order;
    ``keys``: values by keys such as ``ball.center``, see ``_instantiate``. The files that it names are added
    to ``inputs``. Raises ``SceneError`` that calls it ``name``, and ``UsageError`` for an unknown key or a
    value of the wrong type.
    """
    inputs = set() if inputs is None else inputs
    with _loading(name):
        _check_dict(scene)
        state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), scene)
        _check_nodes(state.nodes, inputs)
        return _instantiate(state, merge, keys or {})


def load_file(
    path: str,
    params: Values,
    inputs: set[str] | None = None,
    *,
    options: Values | None = None,
    as_text: bool = False,
) -> tuple[mi.Object | str, Mapping[str, str]]:
    """Return the scene of an XML file, and the values of its ``$parameters``.

    ``params``: values by the names of parameters, and by keys such as ``ball.center``; ``options``: those of
    a render, whose values are used for parameters of the same names.
    ``as_text``: return it as XML, with includes and parameters filled in, and files by their whole path.

    The files that are read are added to ``inputs``. Raises ``SceneError``, and ``UsageError`` for another
    kind of file, a parameter or key that is not in it.
    """
    from mrt_mitsuba.scene.expansion import Expansion
    from mrt_mitsuba.scene.files import require_file

    require_file(path)
    if not path.lower().endswith(".xml"):
        raise UsageError(f"cannot read {path}: a scene file ends in .xml or .obj")
    inputs = set() if inputs is None else inputs
    keys = {key: value for key, value in params.items() if "." in key}
    given = {name: str(value) for name, value in params.items() if name not in keys}
    plain = (option for option in (options or {}).items() if isinstance(option[1], str | int | float))
    offered = {name: str(value) for name, value in plain} | given
    with _loading(path, os.path.dirname(path) or "."):
        expansion = Expansion(dict(offered))
        expansion.read(path)
        _check_parameters(path, given, expansion.known)
        config = mi.parser.ParserConfig(mi.variant())
        config.unused_parameters = mi.LogLevel.Debug  # a file has few of the options
        state = mi.parser.parse_file(config, path, **offered)
        inputs.update(map(str, state.files))
        _check_nodes(state.nodes, inputs)
        if not as_text:
            return _instantiate(state, True, keys), expansion.values
        for node in state.nodes:
            if isinstance(node.props.get("filename", None), str):
                node.props["filename"] = os.path.abspath(_resolved(node.props["filename"]))
        unset, _ = _set_properties(state, keys)
        if unset:
            raise UsageError(f"{path} does not state {min(unset)}: write it into the file")
        return mi.parser.write_string(state), expansion.values


# ---------------------------------------------- Mitsuba's parser ---------------------------------------


def _check_nodes(nodes: Iterable[mi.parser.SceneNode], inputs: set[str]) -> None:
    """Check the plugins, sample counts and files of parsed nodes, and note the files."""
    mitsuba_first()  # a <path> of the file puts its folder before
    for node in nodes:
        kind = node.props.plugin_name()
        filename = node.props.get("filename", None)
        _check_plugin(kind)
        samples = node.props.get("sample_count", 1)
        if isinstance(samples, int) and not 1 <= samples <= MAX_SAMPLE_COUNT:
            raise RuntimeError(f"{kind}: sample_count is {samples}; give 1 to {MAX_SAMPLE_COUNT}")
        if isinstance(filename, str) and filename:
            from mrt_mitsuba.scene.files import require_file

            inputs.add(_resolved(filename))
            if os.path.exists(_resolved(filename)):  # Mitsuba itself reports a missing file
                require_file(_resolved(filename))


def _instantiate(state: mi.parser.ParserState, merge: bool, keys: Values) -> mi.Object:
    """Instantiate the objects, after setting properties that the scene gives (``ball.center``); set other
    keys by ``mi.traverse`` (``ball.to_world``)."""
    unset: Values = {}
    if keys:
        unset, stated = _set_properties(state, keys)
    config = mi.parser.ParserConfig(mi.variant())
    config.parallel = False
    config.merge_meshes = merge
    mi.parser.transform_all(config, state)
    with defer_signals():  # an interrupt would leave plugins half made, and later renders would crash
        loaded = mi.parser.instantiate(config, state)
    if unset:
        set_parameters(loaded, unset, stated)
    return loaded


# Types of properties that can be set, with their names in ``mi.traverse``; the first variant of a process
# decides whether their own names begin with "Scalar"
_TYPE_NAMES = {
    "bool": "bool",
    "int": "int",
    "float": "Float",
    "str": "str",
    "Array3f64": "Point3f",
    "Color3d": "Color3f",
    "AffineTransform4d": "AffineTransform4f",
}


def _kind(value: object) -> str:
    return type(value).__name__.removeprefix("Scalar")


def _set_properties(state: mi.parser.ParserState, keys: Values) -> tuple[Values, list[str]]:
    """Set properties of parsed nodes; return the values of other keys, and the keys of all properties.

    A key is the node's path in a dict, or its id in XML, and the name of the property.
    """
    places = state.node_paths or [node.props.id() for node in state.nodes]
    known = {
        f"{place}.{name}": (node.props, name)
        for node, place in zip(state.nodes, places, strict=True)
        for name in (node.props if place else ())
        if _kind(node.props[name]) in _TYPE_NAMES
    }
    for key in keys.keys() & known.keys():
        properties, name = known[key]
        before = properties[name]
        properties[name] = _converted(key, keys[key], type(before), _TYPE_NAMES[_kind(before)])
    return {key: keys[key] for key in keys if key not in known}, [*known]


def set_parameters(loaded: mi.Object, values: Values, stated: Sequence[str]) -> None:
    """Set values by their ``mi.traverse`` key; raise ``UsageError`` for unknown ones and wrong types.

    ``stated``: keys of properties, which a message may suggest.
    """
    parameters = mi.traverse(loaded)
    for key, value in values.items():
        if key not in parameters:
            close = difflib.get_close_matches(key, [*parameters.keys(), *stated], n=1)
            hint = f"did you mean {close[0]}?" if close else "print(mi.traverse(scene)) lists all"
            raise UsageError(f"the scene has no parameter {key}: {hint}")
        kind = type(parameters[key])
        parameters[key] = _converted(key, value, kind, kind.__name__)
    parameters.update()


def _converted(key: str, value: Any, kind: type, name: str) -> Any:
    """Convert a value to a type; raise ``UsageError`` if it does not fit."""
    try:
        if kind in (str, bool, int) and not isinstance(value, kind):
            raise TypeError
        if "AffineTransform" in name and hasattr(value, "matrix"):
            value = value.matrix
        if kind.__name__.removeprefix("Scalar") in _TYPE_NAMES and hasattr(value, "__array__"):
            value = np.array(value).squeeze()
        return kind(value)
    except (TypeError, ValueError, RuntimeError):
        raise UsageError(f"{key}={value!r}: must be a {name}") from None


@contextlib.contextmanager
def _loading(name: str, folder: str | None = None) -> Iterator[None]:
    """Take plugins from Mitsuba's own folder within the block, and data from ``folder`` as well; turn a
    ``RuntimeError``, of Mitsuba or of the checks below, into a ``SceneError`` that says what was loaded."""
    before = mi.file_resolver()
    mitsuba_first(folder)
    try:
        yield
    except RuntimeError as error:
        raise SceneError(f"cannot load {name}: {one_line(_ORIGIN.sub('', str(error)))}") from error
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


def _check_dict(node: Values, place: str = "", depth: int = 1) -> None:
    """Check every entry: None, cycles and depth would end the process."""
    if depth > MAX_DEPTH:
        raise RuntimeError(f"it is nested more than {MAX_DEPTH} levels deep")
    for key, value in node.items():
        if isinstance(value, dict):
            _check_dict(value, f"{place}{key}.", depth + 1)
        elif value is None:
            raise RuntimeError(f"{place}{key} is None; give it a value, or leave it out")
        elif key == "type" and not isinstance(value, str):
            raise RuntimeError(f"{place}type is {value!r}; give the name of a plugin")
        elif key == "type":
            _check_plugin(value)


def _check_parameters(path: str, given: Iterable[str], known: set[str]) -> None:
    """Raise ``UsageError`` for a parameter that is in no file."""
    for name in set(given) - known - {"focaldist", "focalrange"}:
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(sorted(known)) or 'none'}"
        raise UsageError(f"{path} has no parameter ${name}: {hint}")
