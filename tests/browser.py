"""A real Chromium for the tests of pages: the system's own, driven by Playwright, with software WebGL."""

import shutil
from collections.abc import Generator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, expect, sync_playwright

WAIT_MS = (
    60_000.0  # what a page shows comes at once; a machine with other things to do may take as long as this
)

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


def browsers_own(text: str) -> bool:
    """Whether an error is what a browser itself says of a page that was left before its socket was open."""
    return "WebSocket is closed before the connection is established" in text


@contextmanager
def chromium() -> Generator[Browser]:
    """A running browser. Pages of ours reach nothing outside this machine."""
    path = chromium_path()
    expect.set_options(timeout=WAIT_MS)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_ARGUMENTS, timeout=2.0 * WAIT_MS)
        try:
            yield browser
        finally:
            browser.close()
