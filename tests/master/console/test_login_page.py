"""The login in a real browser: a console for other machines, encrypted, from a wrong password to the logout."""

import http.client
import os
import re
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.browser import WAIT_MS, chromium
from tests.network_helpers import PATIENCE_S


@dataclass
class Served:
    """A console that runs for other machines: its first lines, its page here, and its password."""

    lines: list[str]
    url: str
    password: str


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Generator[Served]:
    folder = tmp_path_factory.mktemp("login")
    words = [
        "console",
        "--port",
        "0",
        "--host",
        "0.0.0.0",
        "--bus",
        "tcp/127.0.0.1:9",
        "--calibration",
        "none",
    ]
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(__file__).resolve().parents[3]),
        "XDG_CONFIG_HOME": str(folder),
    }
    environment.pop("PHALANX_OPEN", None)
    console = subprocess.Popen(
        [sys.executable, "-u", "-m", "master", *words],
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=folder,
    )
    try:
        assert console.stdout is not None
        lines = [console.stdout.readline() for _ in range(3)]
        password = re.search(r"password is (\S+)", lines[0])
        port = re.search(r"https://127\.0\.0\.1:(\d+)/", lines[2])
        assert password is not None
        assert port is not None
        yield Served(lines, f"https://127.0.0.1:{port[1]}/", password[1])
    finally:
        console.terminate()
        assert console.wait(PATIENCE_S) == 0, "the console ends when it is told to"


def test_a_stranger_gets_the_login_and_who_knows_the_password_the_console(served: Served) -> None:
    faults: list[str] = []
    with chromium() as browser:
        context = browser.new_context(
            viewport={"width": 390, "height": 780}, color_scheme="dark", ignore_https_errors=True
        )
        context.set_default_timeout(WAIT_MS)
        context.on("weberror", lambda one: faults.append(str(one.error)))
        page = context.new_page()
        page.goto(served.url + "checklist")
        assert page.url == f"{served.url}login?next=/checklist"
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(15, 19, 24)", (
            "its style is allowed, and dark"
        )
        password = page.get_by_label("Password of this console")
        expect(password).to_be_focused()
        password.fill("not the password")
        page.keyboard.press("Enter")
        expect(page.get_by_role("alert")).to_have_text("This is not the password.")
        page.get_by_label("Password of this console").fill(served.password)
        page.get_by_role("button", name="Log in").click()
        page.wait_for_url("**/checklist")
        expect(page.locator(".console-main:not([inert])")).to_be_visible()
        (cookie,) = (one for one in context.cookies() if "phalanx" in one.get("name", ""))
        assert [cookie.get(key) for key in ("httpOnly", "secure", "sameSite")] == [True, True, "Strict"]
        other = context.new_page()
        other.goto(served.url + "plots")
        expect(other.locator(".console-main:not([inert])")).to_be_visible()
        page.get_by_role("button", name="Log out").click()
        page.wait_for_url("**/login")
        other.wait_for_url("**/login?next=/plots")  # its socket was ended, and it goes to the login by itself
        context.close()
    assert faults == []


def test_without_encryption_there_is_no_answer(served: Served) -> None:
    with pytest.raises((urllib.error.URLError, ConnectionError, http.client.BadStatusLine)):
        urllib.request.urlopen(served.url.replace("https", "http"), timeout=PATIENCE_S)
