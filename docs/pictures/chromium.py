"""Chromium for pictures and tests of pages: an installed one, else Playwright's own."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


class MissingBrowser(Exception):
    """Chromium is not installed, so that pages cannot be shown."""


def launch(playwright: Playwright) -> Browser:
    """Start Chromium, without a window."""
    own = playwright.chromium.executable_path
    path = next(filter(None, map(shutil.which, NAMES)), own)
    if not Path(path).is_file():
        raise MissingBrowser("install Chromium: apt install chromium, or playwright install chromium")
    # as root, as in containers, it starts only without its sandbox; all pages are our own
    alone = ["--no-sandbox"] if os.geteuid() == 0 else []
    return playwright.chromium.launch(executable_path=path, args=alone)
