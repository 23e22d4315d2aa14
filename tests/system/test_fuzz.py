"""Random scene files, pictures and plugin parameters: each is read, or refused with one clear error."""

from __future__ import annotations

import math
import re

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nodes import documented, example

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.plugins.table import PLUGINS
from mrt_mitsuba.scene.open import open_scene

pytestmark = [pytest.mark.fuzz, pytest.mark.filterwarnings("ignore::mrt_mitsuba.errors.MrtWarning")]
# The folder of a test serves all of its inputs, and each writes the same files
one_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


WHOLE = """<scene version='3.0.0'>
<integrator type='mrt_whitted'><integer name='max_depth' value='3'/><float name='min_contribution' value='0'/>
</integrator>
<sensor type='perspective'><float name='fov' value='40'/>
<transform name='to_world'><lookat origin='0,0,5' target='0,0,0' up='0,1,0'/></transform>
<film type='hdrfilm'><integer name='width' value='4'/><integer name='height' value='3'/></film></sensor>
<emitter type='constant'><rgb name='radiance' value='0.2 0.2 0.7'/></emitter>
<emitter type='mrt_light'><point name='position' value='0 3 4'/><rgb name='intensity' value='1'/></emitter>
<bsdf type='mrt_bsdf' id='a'><float name='alpha' value='0.1'/><float name='int_ior' value='1.5'/>
<string name='fresnel' value='schlick'/><rgb name='diffuse_reflectance' value='0.5 0.4 0.3'/></bsdf>
<shape type='sphere'><ref id='a'/></shape>
<shape type='mrt_cone'><point name='apex' value='0 0 1'/><point name='base_center' value='0 0 0'/>
<float name='radius' value='1'/><integer name='segments' value='8'/><ref id='a'/></shape>
<shape type='mrt_plane'><vector name='normal' value='0 1 0'/><float name='distance' value='1'/>
<ref id='a'/></shape></scene>"""
# Words that stand where others stood; sizes of what is allocated stay small enough to be tried
WORDS_OF_XML = """
    0 -1 1 3 1e39 -1e-46 nan inf 1,2,3 a é $x true schlick unity none mrt_bsdf mrt_cone mrt_light
    mrt_plane mrt_whitted mrt_mesh sphere perspective hdrfilm path diffuse scene a.xml ../.. to_world
    alpha float integer rgb string point vector bsdf shape sensor ref transform include default alias
    texture spectrum boolean translate scale id name < > & &amp; &b; ' " <!-- ]]> <a/>
"""
WORDS = [*WORDS_OF_XML.split(), "", "1 2", "0 0 0", "<scene version='3.0.0'/>", "\0", "\n"]
ANY_WORD = st.sampled_from(WORDS) | st.text(max_size=8)
PARTS = re.split(r"([ <>=/'])", WHOLE)


@one_folder
@given(
    changes=st.dictionaries(st.integers(0, len(PARTS) - 1), ANY_WORD, max_size=4),
    cut=st.none() | st.integers(0, len(PARTS)),
)
def test_any_scene_file_is_read_or_refused(tmp_path, variant, changes, cut):
    parts = [changes.get(i, part) for i, part in enumerate(PARTS[:cut])]
    path = tmp_path / "a.xml"
    path.write_bytes("".join(parts).encode(errors="surrogatepass"))
    try:
        source = open_scene(path)
    except (SceneError, UsageError) as error:
        assert "a.xml" in str(error) or "integrator" in str(error)
        assert "Traceback" not in str(error)
        return
    assert source.width > 0
    assert source.height > 0
    assert source.sensor is not None


NUMBERS = [i for i, part in enumerate(PARTS) if part.replace(".", "").replace(",", "").isdigit()]


EXTREMES = ["0", "1", "-1", "1e-30", "1e-9", "1e5", "1e20", "3e38", "0.5", "2"]


@settings(one_folder, max_examples=60)  # each is compiled
@given(changes=st.dictionaries(st.sampled_from(NUMBERS), st.sampled_from(EXTREMES), min_size=1, max_size=3))
def test_any_scene_file_that_is_read_is_drawn(tmp_path, variant, changes):
    """Whatever its numbers, the picture is made of numbers, or one clear error says why there is none."""
    path = tmp_path / "a.xml"
    path.write_text("".join(changes.get(i, part) for i, part in enumerate(PARTS)))
    try:
        image = mrt.render(path, aa=1, aamode="none").image
    except (SceneError, UsageError) as error:
        assert "Traceback" not in str(error)
        return
    assert not np.isnan(image).any()


numbers = st.one_of(st.floats(width=32), st.floats(), st.sampled_from([0.0, -1.0, 1e39, math.nan, math.inf]))
vectors = st.lists(numbers, min_size=3, max_size=3)
colors = st.builds(lambda x: {"type": "rgb", "value": [x, 0.5, 0.5]}, numbers)
simple = st.booleans() | st.integers(-3, 300) | st.text(max_size=6)
values = numbers | simple | vectors | colors


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_parameter_is_taken_or_refused_by_name(variant, data):
    row = data.draw(st.sampled_from(PLUGINS))
    plugin = row.name
    name = data.draw(st.sampled_from(list(documented(row))))
    try:
        mi.load_dict(example(row, **{name: data.draw(values)}))
    except (RuntimeError, TypeError) as error:
        text = str(error)
        assert plugin in text or name in text
        assert f'"{name}"' in text or f"[{name}]" in text or plugin == "mrt_texture", text
