"""A real Chromium for the tests of pages: the system's own, driven by Playwright, with software WebGL."""

import shutil
from collections.abc import Generator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, sync_playwright

_PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
_ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
]


def chromium_path() -> str:
    """Where the browser is; skips the test where there is none."""
    found = next((path for name in _PROGRAMS if (path := shutil.which(name)) is not None), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(_PROGRAMS)} is installed (Debian: apt install chromium)")
    return found


@contextmanager
def chromium() -> Generator[Browser]:
    """A running browser. Pages of ours reach nothing outside this machine."""
    path = chromium_path()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()
