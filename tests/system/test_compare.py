"""``mrt.compare``, ``mrt diff`` and tests of sets of renders: known differences, layers, noise, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from cases import Cases
from numpy.testing import assert_array_equal
from PIL import Image
from scipy import ndimage, stats

import mrt_mitsuba as mrt
from mrt_mitsuba.command.main import main
from mrt_mitsuba.files.images import read_exr, save
from mrt_mitsuba.validation.compare import p_values

pytest.importorskip("flip_evaluator")

GREY = np.full((12, 16, 3), 0.5, np.float32)


def spotted(by: float = 0.1) -> np.ndarray:
    image = GREY.copy()
    image[3, 5, 1] += by
    return image


def test_measures_are_those_of_a_known_difference():
    found = mrt.compare(spotted(), GREY)
    n = GREY.size
    assert found.mae == pytest.approx(0.1 / n, rel=1e-6)
    assert found.rmse == pytest.approx(0.1 / n**0.5, rel=1e-6)
    assert found.rel_mse == pytest.approx(0.01 / n / 0.26, rel=1e-6)
    assert found.psnr == pytest.approx(10 * np.log10(n / 0.01), rel=1e-6)
    srgb = np.diff([1.055 * value ** (1 / 2.4) - 0.055 for value in (0.5, 0.6)])
    assert found.display == pytest.approx(srgb / n**0.5, rel=1e-6)
    assert mrt.compare(GREY + 7, GREY + 1).display == 0  # both are white
    assert found.largest == pytest.approx(0.1, rel=1e-6)
    assert found.place == (3, 5)
    assert found.flip > 0
    assert found.p_value is None
    assert_array_equal(found.difference, spotted() - GREY)
    same = mrt.compare(GREY, GREY)
    assert (same.rmse, same.display, same.psnr, same.largest, same.flip) == (0, 0, np.inf, 0, 0)


def test_flip_chooses_the_exposures_of_the_package():
    import flip_evaluator

    rng = np.random.default_rng(3)
    b = np.float32(rng.gamma(0.7, size=(24, 32, 3)))
    a = np.float32(b * rng.uniform(0.8, 1.2, b.shape))
    expected = flip_evaluator.evaluate(b, a, "HDR", applyMagma=False, parameters={})[1]
    assert mrt.compare(a, b).flip == pytest.approx(expected, rel=1e-3)
    assert mrt.compare(1e-20 * a, 1e-20 * b).flip == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("value", [1e-45, 1e-38, 1e-10, 1.0, 1e30, 3e38])
def test_flip_is_defined_for_dim_and_bright_pictures(value):
    """The package's own choice of exposures ends the process."""
    b = np.full((8, 8, 3), value, np.float32)
    b[0, 0] = 0
    assert mrt.compare(b, b).flip == 0
    for a in (0.99 * b, 0 * b, np.ones_like(b), np.full_like(b, 3e38)):
        assert 0 <= mrt.compare(a, b).flip <= 1
    assert mrt.compare(b, 0 * b).flip is None


def test_flip_is_not_computed_unless_it_is_asked_for(files, monkeypatch, capsys):
    """It takes a minute for a megapixel."""
    asked = []
    monkeypatch.setattr("flip_evaluator.evaluate", lambda *given, **options: (asked.append(1), 0.25))
    found = mrt.compare(spotted(), GREY)
    found.save(Path(files["a"]).with_name("difference"))
    assert main(["diff", files["a"], files["b"], "rmse=0.005"]) == 0
    assert "flip" not in capsys.readouterr().out
    assert asked == []
    assert main(["diff", files["a"], files["b"], "flip=0.5"]) == 0
    assert "ok     flip: 0.25 <= 0.5" in capsys.readouterr().out


def test_infinite_depths_are_equal_where_both_are():
    depth = np.array([[1.0, np.inf], [2.0, np.inf]], np.float32)
    other = np.array([[1.5, np.inf], [2.0, 3.0]], np.float32)
    assert mrt.compare(depth, depth).largest == 0
    assert mrt.compare(depth[:, :1], other[:, :1]).largest == 0.5
    assert mrt.compare(depth, other).mae == np.inf  # one of them hits nothing there


def mean_of(rays: np.ndarray, path: Path) -> Path:
    """Write the mean of rays [N, H, W, C] with its standard error."""
    error = np.sqrt(rays.var(axis=0, ddof=1).mean(axis=-1) / len(rays))
    save(path, np.broadcast_to(rays.mean(axis=0), (*error.shape, 3)), layers={"error.Y": error})
    return path


def test_more_than_noise(tmp_path):
    """The mean of 16 rays: p is small for one picture 2 % brighter, or one pixel off by 14 deviations.

    It is not for a pixel that is noisier in one of the pictures, whichever that is.
    """
    rng = np.random.default_rng(1)

    def noisy(name: str, scale: float, spot: float = 0, noise: float = 0) -> Path:
        rays = 0.5 * scale * (1 + 0.1 * rng.normal(size=(16, 24, 32, 3)))
        rays[:, 7, 9] += spot + noise * rng.normal(size=(16, 1))
        return mean_of(rays, tmp_path / name)

    assert mrt.compare(noisy("a.exr", 1.02), noisy("b.exr", 1)).p_value < 1e-6
    assert mrt.compare(noisy("a.exr", 1.02), 0.5 * np.ones((24, 32, 3))).p_value < 1e-6  # one side exact
    assert mrt.compare(noisy("a.exr", 1, 0.25), noisy("b.exr", 1)).p_value < 1e-3
    pair = noisy("a.exr", 1, noise=5), noisy("b.exr", 1)
    assert min(mrt.compare(*pair).p_value, mrt.compare(*pair[::-1]).p_value) > 0.01


@pytest.mark.parametrize(
    ("share", "deviation"), [(0, 0), (0.01, 0), (0, 0.6), pytest.param(0.0001, 0.6, marks=pytest.mark.slow)]
)
def test_p_value_is_uniform_for_equal_pictures(share, deviation, tmp_path):
    """Also where a few rays are bright, and most pixels state far too small an error, and under filters
    of a Gaussian of some pixels."""
    rng = np.random.default_rng(2)
    size = (16, 24, 32, 1)

    def noisy(name: str) -> Path:
        rays = 0.5 + 0.05 * rng.normal(size=size) + 50 * (rng.random(size) < share)
        return mean_of(ndimage.gaussian_filter(rays, (0, deviation, deviation, 0)), tmp_path / name)

    p = [mrt.compare(noisy("a.exr"), noisy("b.exr")).p_value for _ in range(120)]
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_results_have_layers(variant):
    result = mrt.render(0, width=24, height=18, aa=1, layers=["depth", "normal"])
    assert mrt.compare(result, result.image).largest == 0
    assert mrt.compare(result, result, layer="normal").difference.shape == (18, 24, 3)


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    depth = np.full((12, 16), 2.0, np.float32)
    save(tmp_path / "a.exr", spotted(), layers={"depth.Z": 1.5 * depth})
    save(tmp_path / "b.exr", GREY, layers={"depth.Z": depth})
    save(tmp_path / "nan.exr", np.where(spotted() > 0.55, np.nan, GREY))
    kind = {"type": OpenEXR.scanlineimage}
    shifted = {"dataWindow": ((100, 200), (115, 211)), "displayWindow": ((0, 0), (639, 479))}
    OpenEXR.File(kind | shifted, {"RGB": GREY}).write(str(tmp_path / "shifted.exr"))
    parts = [OpenEXR.Part(kind | {"name": n}, {"RGB": p}) for n, p in (("left", GREY), ("right", spotted()))]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    deep = np.empty((12, 16), object)
    deep[...] = [[np.ones(2, np.float32)] * 16] * 12
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(header, {"R": deep}).write(str(tmp_path / "deep.exr"))
    return {path.stem: str(path) for path in tmp_path.iterdir()}


commands = Cases()
commands(("a", "b"), 0, "rmse     0.004167")
commands(("a", "b", "rmse=0.005", "largest=0.2", "psnr=40", "flip=0.5"), 0, "ok     psnr: 47.6 >= 40")
commands(("a", "b", "rmse=0.004", "largest=0.2"), 1, "MISSED rmse: 0.004167 <= 0.004")
commands(("a", "b", "layer=depth", "mae=0.5"), 1, "MISSED mae: 1 <= 0.5")
commands(("a", "b", "p_value=0.1"), 2, 'layer "error"')
commands(("a", "b", "layer=normal"), 2, "has no layer 'normal'; it has B, G, R, depth")
commands(("nan", "b"), 2, "is NaN in 1 pixels, the first at row 3, column 5")
commands(("a", "shifted"), 2, "the data windows (0, 0, 15, 11) and (100, 200, 115, 211)")
commands(("parts", "parts", "layer=right", "largest=0"), 0, "ok     largest")
commands(("a", "parts"), 2, "has no layer 'R, G, B'; it has left, right")
commands(("a", "deep"), 2, "many values in a pixel; flatten it first")
commands(("a", "b", "rsme=1"), 2, "unknown option 'rsme'. Did you mean rmse?")


@pytest.mark.parametrize(("words", "code", "said"), commands)
def test_command(words, code, said, files, capfd):
    assert main(["diff", *(files.get(word, word) for word in words)]) == code
    out, err = capfd.readouterr()
    assert said in (err if code == 2 else out)
    assert err.count("\n") == (code == 2)


def test_difference_is_written(files, tmp_path, capsys):
    assert main(["diff", files["a"], files["b"], f"out={tmp_path / 'd.png'}"]) == 0
    written = read_exr(tmp_path / "d.exr")
    assert_array_equal(written.image, spotted() - GREY)
    shown = np.asarray(Image.open(tmp_path / "d.png")).astype(int).sum(axis=-1)
    assert np.argwhere(shown > 20).tolist() == [[3, 5]]
    assert main(["diff", files["a"], files["b"], f"out={tmp_path}/no/such/place"]) == 2
    before = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "link.png").symlink_to("a.exr")
    for out in ("a", "b.exr", "../" + tmp_path.name + "/a", "link"):
        assert main(["diff", files["a"], files["b"], f"out={tmp_path}/{out}"]) == 2
    assert (tmp_path / "a.exr").read_bytes() == before
    assert not (tmp_path / "a.png").exists()


# ------------------------------------------ Sets of renders ------------------------------------------

SHAPE = (24, 32, 3)
Y, X = np.mgrid[:24, :32] / 24
TRUTH = np.stack([0.2 + X, 0.5 * Y, np.maximum(X - 0.5, 0)], axis=-1)  # bright, dim and black places


def renders(picture: np.ndarray, seed: int, draw: str = "normal") -> np.ndarray:
    """Eight renders with noise of mean 0 and a tenth of the picture as standard deviation."""
    random = np.random.default_rng(seed)
    size = (8, *picture.shape)
    noise = random.normal(size=size) if draw == "normal" else random.gamma(16, size=size) / 4 - 4
    return picture * (1 + 0.1 * noise)


def least(ours: Any, theirs: Any) -> float:
    return min(p_values(ours, theirs).values())


def pair(changed: np.ndarray, seed: int = 0, draw: str = "normal") -> dict[str, float]:
    return p_values(renders(changed, 2 * seed, draw), renders(TRUTH, 2 * seed + 1, draw))


@pytest.mark.parametrize("draw", ["normal", "gamma"])
def test_equal_pictures_are_rejected_as_often_as_the_level_says(draw):
    """gamma: noise as skewed as a mean of 16 exponential samples, which a picture's noise resembles."""
    level = 0.1
    trials = 300
    found = np.array([list(pair(TRUTH, i, draw).values()) for i in range(trials)])
    # bounds fail a right test once in ten thousand times; the seeds are fixed
    one = 1 - (1 - level) ** (1 / 3)
    for p, rate in zip((*found.T, found.min(axis=1)), (one, one, one, level), strict=True):
        low, high = stats.binom.interval(0.9998, trials, rate)
        assert low <= (p < level).sum() <= high


SPOT, PATCH, EDGE = np.ones((3, *SHAPE))
SPOT[5, 7] = 1.8  # 16 standard deviations of the difference of means
PATCH[:16, :16] = 1.07  # one of four tiles: each of its pixels is off by 1.4 standard deviations only
EDGE[16:, 16:] = 1.09  # the last tile, which is half as high


@pytest.mark.parametrize(
    ("factor", "seen", "unseen"),
    [(1.02, "image", "pixel"), (SPOT, "pixel", "image"), (PATCH, "tile", "pixel"), (EDGE, "tile", "pixel")],
)
def test_each_question_sees_what_the_others_do_not(factor, seen, unseen):
    """A scale by the mean, a pixel by itself, a patch by its tile."""
    found = pair(factor * TRUTH)
    assert found[seen] < 1e-3 < found[unseen]


def test_a_picture_without_noise_is_compared_too():
    """The sky has no noise at all: there any difference counts, but that of rounding does not."""
    flat = np.full((8, *SHAPE), 0.3)
    assert least(flat.astype(np.float32), flat) > 0.1
    spot = flat.copy()
    spot[:, 3, 4, 1] += 1e-3
    assert p_values(spot, flat)["pixel"] < 1e-3
    assert least(0 * flat, 0 * flat) == 1
    assert least(renders(1.05 * TRUTH, 1), [TRUTH, TRUTH]) < 1e-3 < least(renders(TRUTH, 1), [TRUTH, TRUTH])


# In one process, since importing SciPy and Matplotlib takes longer than all else; our own modules that use
# them are imported anew for each case, and nothing of what is missing was imported before the first
DOORS = """
import sys
import numpy as np
import mrt_mitsuba as mrt
mrt.register()
picture = np.full((4, 4, 3), 0.5, np.float32)
scene = mrt.scene_dict(0, width=8, height=6)
case = {"aa": 1, "aamode": "none"}
few = {"size": 8, "spp": 1, "renders": 2, "pairs": 100}
times = {"reference": case | {"aa": 2}, "repeats": 2}
doors = {
    "check": lambda: mrt.check_bsdf({"type": "diffuse"}, quick=True, only=["eval_pdf"]).save("check"),
    "page": lambda: mrt.check_emitter({"type": "constant"}, quick=True, only=["density"])._repr_html_(),
    "compare": lambda: mrt.compare(picture, picture).save("compare"),
    "errors": lambda: mrt.error_vs_time(scene, {"a": case}, **times).save("e"),
    "rough": lambda: mrt.compare_roughconductor(alpha=0.3, **few),
    "sweep": lambda: mrt.sweep(0, "sweep", grid={"seed": [1]}, workers=1, width=8, height=6, **case),
}

OURS = "mrt_mitsuba.validation", "mrt_mitsuba.sweeps"

def within(packages):
    return [name for name in sys.modules if f"{name}.".startswith(tuple(f"{p}." for p in packages))]

assert not {"jinja2", "scipy", "matplotlib", "dask"} & sys.modules.keys()
for missing, tried in CASES:
    for name in within(OURS):
        del sys.modules[name]
    for name, value in list(vars(mrt).items()):
        if getattr(value, "__module__", "").startswith(OURS):
            delattr(mrt, name)
    hidden = {*missing, *within(missing)}
    known = {name: sys.modules[name] for name in hidden if name in sys.modules}
    sys.modules.update(dict.fromkeys(hidden))
    closed = []
    for name in tried:
        try:
            doors[name]()
        except mrt.MrtError as error:
            assert "is not installed: pip install 'mrt-mitsuba[" in str(error), (name, error)
            closed.append(name)
    print(*missing, "closes", *closed)
    for name in hidden:
        del sys.modules[name]
    sys.modules.update(known)
"""
HERE = ["check", "page", "compare", "errors", "rough"]  # doors that need no other process
CLOSED = """
jinja2 closes check page errors
scipy closes check page errors
matplotlib closes compare errors
dask closes sweep
jinja2 scipy matplotlib closes
"""


@pytest.mark.slow
def test_doors_say_what_is_not_installed(run_python):
    cases = [(["jinja2"], HERE), (["scipy"], HERE), (["matplotlib"], HERE)]
    cases += [(["dask"], [*HERE, "sweep"]), (["jinja2", "scipy", "matplotlib"], ["sweep"])]
    assert run_python(DOORS.replace("CASES", repr(cases))).stdout == CLOSED.lstrip()
