"""``params``: values of a scene set once it is loaded."""

from __future__ import annotations

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import UsageError

SIZE = {"width": 32, "height": 24, "aa": 1}


def test_a_render_with_params_is_that_of_the_scene_changed_by_hand(variant: str) -> None:
    import mitsuba as mi

    values = {"material_0.alpha": 0.5, "light_1.intensity.value": [0.2, 0.4, 0.6]}
    scene = mi.load_dict(mrt.scene_dict(3, width=32, height=24))
    parameters = mi.traverse(scene)
    parameters["material_0.alpha"] = mi.Float(0.5)
    parameters["light_1.intensity.value"] = mi.Color3f(0.2, 0.4, 0.6)
    parameters.update()
    result = mrt.render(3, params=values, focaldist=0, **SIZE)
    np.testing.assert_array_equal(result.image, mrt.render(scene, aa=1, lattice="report").image)
    assert result.options["params"] == values
    assert abs(result.image - mrt.render(3, focaldist=0, **SIZE).image).max() > 0.1


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"material_0.alpa": 1}, "no parameter material_0.alpa: did you mean material_0.alpha?"),
        ({"x.y": 1}, r"no parameter x.y: print\(mi.traverse\(scene\)\) lists all"),
        ({"material_0.alpha": "rough"}, "material_0.alpha='rough': must be a Float"),
        ({"light_0.intensity.value": [1, 2]}, "must be a Color3f"),
        ({"alpha": 1}, "alpha is not a key of mi.traverse"),
        (3, "must be a dict of values"),
    ],
)
@pytest.mark.usefixtures("variant")
def test_what_cannot_be_set(params: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        mrt.render(3, params=params, **SIZE)


@pytest.mark.usefixtures("variant")
def test_a_loaded_scene_is_not_changed() -> None:
    import mitsuba as mi

    scene = mi.load_dict(mrt.scene_dict(0))
    with pytest.raises(UsageError, match="change a loaded one"):
        mrt.render(scene, params={"material_0.alpha": 0.5})
