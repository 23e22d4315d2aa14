"""The numbered scenes as numbers and pictures; scenes from OBJ files."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from nodes import sensor
from numpy.testing import assert_allclose, assert_array_equal

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import MrtError, MrtWarning, SceneError
from mrt_mitsuba.scene.export import write_xml
from mrt_mitsuba.scene.model import Camera, Material, Scene, Sphere
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.scene.report import report_scene

SIZE = {"width": 96, "height": 72, "aa": 1}


@pytest.mark.parametrize(("number", "triangles"), [(5, 1588), (6, 646), (7, 7620), (8, 12)])
def test_scenes_of_models_render_and_repeat(number, triangles):
    """Mitsuba leaves merged meshes in another order every time, and with it their numbers in layers; these
    keep that of the scene."""
    assert sum(len(mesh.faces) for mesh in report_scene(number).meshes) == triangles
    image = mrt.render(number, **SIZE).image
    assert np.isfinite(image).all()
    assert 0.1 < image.mean() < 0.8
    assert image.std() > 0.1
    assert np.array_equal(image, mrt.render(number, **SIZE).image)
    nodes = mrt.scene_dict(number)
    names = [shape.id() for shape in open_scene(number).scene.shapes()]
    assert names == [name for name in nodes if name in names]
    assert "mesh_0" in names


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_scene_of_an_obj_file(tmp_path, scale):
    """All of the model is in view, from in front, whatever its size and place."""
    corners = np.indices((2, 2, 2)).reshape(3, -1).T
    lines = [f"v {scale * (7 + x)} {scale * (y - 2)} {scale * z}" for x, y, z in corners]
    faces = ["f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2", "f 3 4 8 7", "f 1 3 7 5", "f 2 6 8 4"]
    (tmp_path / "cube.obj").write_text("\n".join(lines + faces))
    result = mrt.render(str(tmp_path / "cube.obj"), **SIZE, layers=["depth"])
    hit = np.isfinite(result.layers["depth.Z"])
    assert 0.1 < hit.mean() < 0.6
    assert not (hit[0].any() or hit[-1].any() or hit[:, 0].any() or hit[:, -1].any())
    assert result.image[hit].mean() > 0.1


@pytest.mark.parametrize("scale", [1e-3, 1, 1e5])
@pytest.mark.parametrize("integrator", ["mrt_whitted", "path"])
def test_a_scene_of_any_size_is_seen_whole(scale, integrator):
    """Neither clipped in front nor at the back: a black ball under a sky."""
    black = Material(1.5, 0.1, (0, 0, 0), (0, 0, 0))
    ball = Sphere((0, 0, 0), scale, black)
    scene = Scene(Camera((0, 0, 5 * scale), (0, 0, 0)), (0.25, 0.5, 1), (), spheres=(ball,))
    image = mrt.render(scene, width=16, height=12, aa=1, aamode="none", integrator=integrator).image
    assert_array_equal(image[5:7, 7:9], 0)
    assert_allclose(image[[0, -1]], np.broadcast_to([0.25, 0.5, 1], (2, 16, 3)), rtol=1e-6)


@pytest.mark.parametrize(("more", "kind"), [({}, "path"), ({"interior": {"type": "homogeneous"}}, "volpath")])
def test_a_scene_without_integrator_is_rendered_by_a_path_tracer(more, kind):
    """The light of a mirror image, which ``mrt_whitted`` does not see; the report's scenes keep theirs."""
    nodes = {"type": "scene", "sensor": sensor([0, 0, 5], [0, 0, 0], (8, 6)), "sky": {"type": "constant"}}
    nodes["ball"] = {"type": "sphere", "bsdf": {"type": "dielectric"}, **more}
    options = {"spp": 4, "width": 8, "height": 6}
    expected = mrt.render(nodes, integrator=kind, **options).image
    for scene in (nodes, mi.load_dict(nodes)):
        with pytest.warns(MrtWarning, match=f"no integrator: it is rendered with integrator={kind};"):
            assert_array_equal(mrt.render(scene, **options).image, expected)


OUTER = """<scene version="3.0.0"><integrator type="$integrator"/><include filename="$where/inner.xml"/>
<default name="whereas" value="sky"/><include filename="$whereas.xml"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>
<integer name="height" value="3"/></film><sampler type="independent">
<integer name="sample_count" value="$spp"/></sampler></sensor></scene>"""
INNER = """<scene version="3.0.0"><default name="glow" value="2"/><include filename="sky.xml"/></scene>"""
SKY = """<scene version="3.0.0"><shape type="sphere" id="ball"><float name="radius" value="1"/>
<point name="center" x="0" y="0" z="99"/></shape><emitter type="constant" id="sky">
<rgb name="radiance" value="$glow"/></emitter></scene>"""


@pytest.fixture
def nested(tmp_path):
    """An XML file that includes one in a folder, which includes one next to itself, and one of that name."""
    (tmp_path / "in").mkdir()
    above = '<scene version="3.0.0"><default name="dim" value="1"/></scene>'
    for name, text in (("outer", OUTER), ("in/inner", INNER), ("in/sky", SKY), ("sky", above)):
        (tmp_path / f"{name}.xml").write_text(text)
    return tmp_path / "outer.xml"


ALL = {"integrator": "path", "where": "in", "spp": 4}
found = Cases()
found({"params": ALL}, 2, 4)  # the default of an included file
found({"params": ALL | {"glow": 3}}, 3, 4)
found({"params": {"where": "in"}, "integrator": "direct", "spp": 9}, 2, 9)  # options fill in parameters
found({"params": ALL, "spp": 9}, 2, 9)
found({"params": ALL | {"sky.radiance": [5, 5, 5]}}, 5, 4)  # what a file states
found({"params": ALL | {"ball.center": [0, 0, 5], "ball.radius": 9}}, 0, 4)


@pytest.mark.parametrize(("options", "value", "rays"), found)
def test_parameters_of_a_file_and_those_that_it_includes(nested, options, value, rays):
    result = mrt.render(nested, **options)
    assert_allclose(np.median(result.image), value, rtol=1e-6)
    assert result.plan.passes[0].pattern.size == rays
    (where,) = write_xml(nested, nested.parent / "flat.xml", params=ALL)
    assert mrt.render(where).plan.passes[0].pattern.size == 4


wrong = Cases()
wrong(ALL | {"glo": 3}, r"has no parameter \$glo: did you mean glow\?")
wrong(ALL | {"zzz": 3}, r"has no parameter \$zzz: it has dim, glow, integrator, spp, where, whereas")
wrong({"where": "in"}, r"undefined parameter: \$integrator")
wrong(ALL | {"ball.centre": [0, 0, 5]}, r"no parameter ball.centre: did you mean ball.center\?")
wrong(ALL | {"ball.center": [0, 5]}, "must be a Point3f")
wrong(ALL | {"glow": "1" * (2**24 + 1)}, "its parameters expand to more than 16777216 characters")


@pytest.mark.parametrize(("params", "message"), wrong)
def test_parameters_that_are_refused(nested, params, message):
    with pytest.raises(MrtError, match=message):
        mrt.render(nested, params=params)


DOUBLE = "".join(f'<default name="a{i:02}" value="{f"$a{i - 1:02}" * 9 if i else "x"}"/>' for i in range(12))


MANY = f'<default name="a" value="{"x" * 2**20}"/>' + '<default name="b" value="$a"/>' * 17


@pytest.mark.parametrize("text", [DOUBLE, MANY, '<include filename="in/inner.xml"/>' * 501])
def test_files_that_multiply_are_refused(nested, text):
    """Gigabytes from some hundred bytes: of parameters that name each other, of files included many times."""
    nested.write_text(f'<scene version="3.0.0">{text}</scene>')
    with pytest.raises(SceneError, match=r"expand to more than|includes more than 1000 files"):
        mrt.render(nested)
