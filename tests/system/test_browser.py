"""The site, a check's page and the validation's page as a browser shows them: ``make browser``.

Chromium is driven by Playwright; without either, these tests are skipped. The site is the one that ``make
docs`` left behind, else one that is built here without running the pages' code.
"""

from __future__ import annotations

import functools
import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlparse

import chromium as browsers  # docs/pictures
import pytest

import mrt_mitsuba as mrt

DOCS = Path(__file__).parents[2] / "docs"
WIDTHS = (1200, 400)  # a window and a phone

pytestmark = pytest.mark.browser

# Of a page: pictures that were not drawn; links; its width; code that is cut off
FACTS = """async () => {
  const images = [...document.images];
  images.forEach(image => { image.loading = "eager"; });
  await Promise.allSettled(images.map(image => image.decode()));
  const shown = [...document.querySelectorAll("article pre")].filter(pre => pre.offsetParent);
  return {
    broken: images.filter(image => image.naturalWidth === 0).map(image => image.src),
    links: [...document.querySelectorAll("a[href]")].map(link => link.href),
    width: document.scrollingElement.scrollWidth,
    cut: shown.filter(pre => pre.scrollWidth > pre.clientWidth + 1).map(pre => pre.innerText.slice(0, 80)),
  };
}"""


@pytest.fixture(scope="module")
def chromium():
    playwright = pytest.importorskip("playwright.sync_api", reason="make browser installs it")
    with playwright.sync_playwright() as started:
        try:
            browser = browsers.launch(started)
        except browsers.MissingBrowser as missing:
            pytest.skip(str(missing))
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    built = DOCS / "_build"
    if (built / "index.html").is_file():
        return built
    pytest.importorskip("sphinx", reason="make browser installs it")
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "sphinx", "-q", "-D", "nb_execution_mode=off", DOCS, folder]
    subprocess.run(words, check=True, timeout=300)
    return folder


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The page of ``mrt-validate``, of the study that takes the least time."""
    folder = tmp_path_factory.mktemp("report")
    words = [Path(sys.executable).with_name("mrt-validate"), "roughconductor", "--quick", "--out", folder]
    subprocess.run(words, check=True, timeout=300, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def check(tmp_path_factory):
    """The page of a check with laws that fail, whose programs are shown."""
    folder = tmp_path_factory.mktemp("check")
    mrt.check_bsdf({"type": "roughdielectric", "sample_visible": False}, quick=True).save(folder)
    return folder


@functools.cache
def places_of(page: Path) -> set[str]:
    """The names of the places of a page that links may lead to."""
    return set(re.findall(r'id="([^"]*)"', page.read_text()))


@functools.cache
def is_dead(link: str) -> bool:
    """Whether a link leads to a file that does not exist, or to a place that its page does not have."""
    parts = urlparse(link)
    if parts.scheme != "file":
        return False
    path = Path(unquote(parts.path))
    place = unquote(parts.fragment)
    return not path.is_file() or (bool(place) and place not in places_of(path))


def faults(chromium, page: Path) -> list[str]:
    """What is wrong with a page in windows of ``WIDTHS``."""
    said = []
    tab = chromium.new_page()
    tab.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.goto(page.as_uri())
    wrong = []
    for width in WIDTHS:
        tab.set_viewport_size({"width": width, "height": 900})
        facts = tab.evaluate(FACTS)
        if facts["width"] > width:
            wrong.append(f"{facts['width']} pixels wide in a window of {width}")
        if width == max(WIDTHS):
            wrong += [f"code cut off: {text}" for text in facts["cut"]]
    tab.close()
    wrong += [f"console: {text}" for text in said]
    wrong += [f"broken picture: {source}" for source in facts["broken"]]
    wrong += [f"dead link: {link}" for link in facts["links"] if is_dead(link)]
    return wrong


@pytest.mark.parametrize("pages", ["site", "check", "report"])
def test_pages_are_whole(pages, chromium, request) -> None:
    folder = request.getfixturevalue(pages)
    wrong = {page.name: faults(chromium, page) for page in sorted(folder.rglob("*.html"))}
    assert wrong and not {name: found for name, found in wrong.items() if found}


def test_faults_of_a_page_are_found(chromium, tmp_path) -> None:
    page = tmp_path / "page.html"
    page.write_text(
        "<!doctype html><body style='margin: 0'>"
        "<img src='none.png' alt=''><a href='none.html'>x</a><a href='#none'>y</a>"
        "<div style='width: 1300px'>z</div>"
        "<article><pre style='width: 20px; overflow: auto'>far too long</pre></article>"
        "<script>console.error('loud'); undefined.name</script>"
    )
    found = faults(chromium, page)
    for word in ("loud", "undefined", "broken picture", "none.html", "#none", "1300", "far too long"):
        assert any(word in fault for fault in found), word
