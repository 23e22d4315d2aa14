"""Loading dicts and XML files with Mitsuba, after a look at what they would make it do.

Mitsuba takes a plugin from ``plugins/NAME.so`` in the first folder of its file resolver that has one, and the
folders of a scene and of the process come before its own: a file that lies there would run as native code.
Here Mitsuba's own folder comes first, and a plugin that only another folder has is refused; the other folders
serve for data. Files that are read without an end (pipes, devices) and elements nested so deep that Mitsuba's
parser would end the process are refused as well.

Objects are made one after the other. In parallel, Mitsuba makes Python objects inside each other, to the
limit of the stack, and Dr.Jit's messages may wait for each other for ever; one by one takes no longer.
``mrt_mitsuba.loaders.one_by_one`` makes that the default of Mitsuba's own loaders for our plugins.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.loaders import mitsuba_first, mitsuba_home
from mrt_mitsuba.memory import Budget
from mrt_mitsuba.scene.files import picture_size, require_file

DEEPEST = 256  # levels of nesting; Mitsuba's parser overflows its stack from about 3000 on
_PICTURES = ("mrt_texture", "bitmap", "envmap")  # plugins that read one
_NATIVE = (".so", ".dylib", ".dll")

# The lines of a traceback, which are indented but for the first, and the type of this project's error
_TRACEBACK = re.compile(
    r"Traceback \(most recent call last\):\n(?:[ \t][^\n]*\n|\n)*(?:\w*ParameterError: )?"
)
# Where in Mitsuba's own sources an error was raised
_CODE_PLACE = re.compile(r"\[\w+\.(?:cpp|h):\d+\] ")


def load_dict(
    scene: Mapping[str, Any], name: str = "the dict", budget: Budget | None = None, *, merge: bool = True
) -> Any:
    """Return what a Mitsuba dict describes.

    ``merge``: make one of meshes of the same material, as Mitsuba does, which leaves them in any order.
    Raises ``SceneError`` that calls it ``name``, and ``UsageError`` for a texture too large for the budget.
    """
    import mitsuba as mi

    with _resolving(None):
        _check_dict(scene, name)
        return _make(lambda config: mi.parser.parse_dict(config, scene), name, budget, merge)


def load_file(path: str, budget: Budget | None = None, **parameters: Any) -> tuple[Any, Mapping[str, str]]:
    """Return the scene of an XML file, and its ``$parameters`` with the values given or by default.

    Raises ``SceneError``, and ``UsageError`` for another kind of file or a texture too large for the budget.
    """
    import mitsuba as mi

    require_file(path)
    if not path.lower().endswith(".xml"):
        raise UsageError(f"cannot read {path}: a scene file ends in .xml or .obj")
    if budget is not None:
        budget.inputs.add(path)
    given = {key: str(value) for key, value in parameters.items()}
    with _resolving(os.path.dirname(path) or "."):
        values = _check_xml(path, given)
        return _make(lambda config: mi.parser.parse_file(config, path, **given), path, budget), values


def declared(path: str) -> dict[str, str]:
    """Return the parameters that an XML file declares, with their defaults. Raises ``SceneError``."""
    require_file(path)
    with open(path, "rb") as stream:
        tags = [tag for tag in _tags(stream.read()) if tag.startswith(b"<default")]
    found = [{key: _text(value) for key, value in _ATTRIBUTE.findall(tag)} for tag in tags]
    return {each.get(b"name", ""): each.get(b"value", "") for each in found}


def _make(parse: Callable[[Any], Any], name: str, budget: Budget | None, merge: bool = True) -> Any:
    """Parse, check and instantiate."""
    import mitsuba as mi

    config = mi.parser.ParserConfig(mi.variant())
    config.parallel, config.merge_meshes = False, merge
    try:
        state = parse(config)
        mitsuba_first()  # a <path> of the file puts its folder before
        for node in state.nodes:
            kind, filename = node.props.plugin_name(), node.props.get("filename", None)
            _check_plugin(kind, name)
            if isinstance(filename, str):
                _check_data(filename)
                size = picture_size(_resolved(filename)) if kind in _PICTURES else None
                if budget is not None:
                    budget.inputs.add(_resolved(filename))
                if budget is not None and size is not None:
                    budget.take_texture(_resolved(filename), *size, around=kind == "envmap")
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state)
    except RuntimeError as error:
        # Mitsuba quotes the traceback, too, where the plugin is written in Python
        text = _CODE_PLACE.sub("", _TRACEBACK.sub("", str(error)))
        raise SceneError(f"cannot load {name}: {text}") from error


# ---------------------------------------------- Folders ------------------------------------------------


@contextlib.contextmanager
def _resolving(folder: str | None) -> Iterator[None]:
    """Take plugins from Mitsuba's own folder within the block, and data from ``folder`` as well."""
    import mitsuba as mi

    before = mi.file_resolver()
    mitsuba_first(folder)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


def _resolved(path: str) -> str:
    import mitsuba as mi

    return str(mi.file_resolver().resolve(path))


# ---------------------------------------------- Checks -------------------------------------------------


def _check_plugin(plugin: str, name: str) -> None:
    """Refuse a native plugin that lies outside Mitsuba's folder. Mitsuba reports a name that it knows not."""
    if plugin == "scene":  # never looked up
        return
    for ending in _NATIVE:
        file = os.path.join("plugins", plugin + ending)
        strange = "/" in plugin or not os.path.isfile(os.path.join(mitsuba_home(), file))
        if strange and os.path.exists(_resolved(file)):
            raise SceneError(
                f"cannot load {name}: the plugin {plugin!r} is {_resolved(file)}, native code that is not "
                f"Mitsuba's; move it away or, if you trust it, into {mitsuba_home()}/plugins"
            )


def _check_data(filename: str) -> None:
    """Refuse a pipe, a device or a folder. Mitsuba reports a file that is missing."""
    path = _resolved(filename)
    if os.path.exists(path):
        require_file(path)


def _check_dict(scene: Mapping[str, Any], name: str) -> None:
    """Look at every entry. None, cycles and depth would end the process."""
    waiting = [("", scene, 1)]
    while waiting:
        place, node, depth = waiting.pop()
        if depth > DEEPEST:
            raise SceneError(f"cannot load {name}: it is nested more than {DEEPEST} levels deep")
        for key, value in node.items():
            if value is None:
                raise SceneError(
                    f"cannot load {name}: {place}{key} is None; give it a value, or leave it out"
                )
            if isinstance(value, dict):
                waiting.append((f"{place}{key}.", value, depth + 1))
            elif key == "type" and not isinstance(value, str):
                raise SceneError(f"cannot load {name}: {place}type is {value!r}; give the name of a plugin")
            elif key == "type":
                _check_plugin(value, name)
            elif key == "filename" and isinstance(value, str):
                _check_data(value)


_ATTRIBUTE = re.compile(rb"""\b(\w+)\s*=\s*("[^"]*"|'[^']*')""")
_TAG_MARK = re.compile(rb"""[>"']""")
_NO_TAGS = ((b"<!--", b"-->"), (b"<![CDATA[", b"]]>"), (b"<?", b"?>"), (b"<!", b">"))


def _check_xml(path: str, parameters: Mapping[str, str]) -> Mapping[str, str]:
    """Look at an XML file and those that it includes before Mitsuba opens them; return its parameters."""
    values, waiting, seen = dict(parameters), [path], set()
    while waiting:
        file = waiting.pop()
        if file in seen:
            continue
        seen.add(file)
        require_file(file)
        with open(file, "rb") as stream:
            data = stream.read()
        if b"\0" in data:
            raise SceneError(f"cannot load {file}: it holds zero bytes; save it as text in UTF-8")
        depth = 0
        for tag in _tags(data):
            depth += -1 if tag.startswith(b"</") else not tag.endswith(b"/>")
            if depth > DEEPEST:
                raise SceneError(f"cannot load {file}: it is nested more than {DEEPEST} levels deep")
            if b"filename" in tag or tag.startswith(b"<default"):
                attributes = {key.decode(): _text(value) for key, value in _ATTRIBUTE.findall(tag)}
                if tag.startswith(b"<default"):
                    values.setdefault(attributes.get("name", ""), attributes.get("value", ""))
                elif "filename" in attributes:
                    filename = _with_values(attributes["filename"], values)
                    _check_data(filename)
                    if tag.startswith(b"<include") and os.path.isfile(_resolved(filename)):
                        waiting.append(_resolved(filename))
    return values


def _tags(data: bytes) -> Iterator[bytes]:
    """Yield opening and closing tags of XML, up to the first that has no end."""
    start = data.find(b"<")
    while start >= 0:
        closing = next((end for begin, end in _NO_TAGS if data.startswith(begin, start)), None)
        end = _end_of_tag(data, start) if closing is None else data.find(closing, start + 2)
        if end < 0:
            return
        if closing is None:
            yield data[start : end + 1]
        start = data.find(b"<", end)


def _end_of_tag(data: bytes, position: int) -> int:
    """Return the place of the next ``>`` outside quotes, or -1."""
    while mark := _TAG_MARK.search(data, position):
        if mark[0] == b">":
            return mark.start()
        position = data.find(mark[0], mark.end()) + 1
        if position == 0:
            break
    return -1


def _text(quoted: bytes) -> str:
    import html

    return html.unescape(quoted[1:-1].decode(errors="replace"))


def _with_values(text: str, values: Mapping[str, str]) -> str:
    """Put values in the place of ``$names``, the longest name first, as Mitsuba does."""
    for name in sorted(values, key=len, reverse=True):
        text = text.replace(f"${name}", values[name]) if name else text
    return text
