"""The console's pages in a real browser, with a master and slaves on a real bus: seen, used by keys, left again."""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from common.bus.zenoh_bus import ZenohBus
from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.output_settings import OutputSettings
from common.messages import CheckItem
from tests.browser import WAIT_MS, browsers_own, chromium
from tests.master.console.fakes import HEIGHT, WIDTH, FakeMaster, FakeSlave, tree
from tests.network_helpers import PATIENCE_S, free_endpoint, until
from tests.sockets import listeners, rows, undocumented

AGAIN_S = 10.0
LAPTOP, TABLET, UPRIGHT = (1366, 800), (1024, 768), (768, 1024)


@dataclass
class Desk:
    """A console that runs, and the fakes that it shows."""

    url: str
    calibration: Path
    master: FakeMaster
    left: FakeSlave
    right: FakeSlave
    browser: Browser
    pid: int
    faults: list[str] = field(default_factory=list[str])


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Generator[Desk]:
    folder = tmp_path_factory.mktemp("console")
    calibration, endpoint = tree(folder), free_endpoint()
    bus = ZenohBus(endpoint, None)
    left, right = (FakeSlave(bus, calibration / "cameras" / f"{name}.json") for name in ("left", "right"))
    master = FakeMaster(bus, [left, right])
    words = ["console", "--port", "0", "--bus", endpoint, "--calibration", str(calibration)]
    console = subprocess.Popen(
        [sys.executable, "-u", "-m", "master", *words],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])},
        cwd=folder,
    )
    try:
        assert console.stdout is not None
        found = re.search(r"http://127\.0\.0\.1:\d+/", console.stdout.readline())
        assert found is not None
        with chromium() as browser:
            yield Desk(found[0], calibration, master, left, right, browser, console.pid)
    finally:
        console.terminate()
        assert console.wait(PATIENCE_S) == 0, "the console ends when it is told to"
        master.close()
        bus.close()


@pytest.fixture(scope="module")
def window(desk: Desk) -> Generator[Page]:
    """One window for all tests, which notes every fault, and every request to somewhere else."""
    context = desk.browser.new_context(
        viewport={"width": LAPTOP[0], "height": LAPTOP[1]}, color_scheme="light"
    )
    context.set_default_timeout(WAIT_MS)
    context.on("console", lambda one: desk.faults.append(one.text) if one.type == "error" else None)
    context.on("weberror", lambda one: desk.faults.append(str(one.error)))
    own = (desk.url, desk.url.replace("http", "ws"), "data:", "blob:")
    context.on("request", lambda one: None if one.url.startswith(own) else desk.faults.append(one.url))
    yield context.new_page()
    context.close()


@pytest.fixture
def page(desk: Desk, window: Page) -> Generator[Page]:
    desk.faults.clear()
    desk.left.commands.clear()
    desk.master.commands.clear()
    yield window
    assert not [fault for fault in desk.faults if not browsers_own(fault)]


def show(desk: Desk, page: Page, name: str) -> None:
    """Open a page, unless it is open, and see that it fits and follows the system's colours."""
    if page.url == desk.url + name:
        return
    page.goto(desk.url + name)
    expect(page.locator(".console-main:not([inert])")).to_be_visible(timeout=WAIT_MS)
    expect(page.get_by_role("status").filter(has_text="connected").first).to_be_visible(timeout=WAIT_MS)
    expect(page.locator(".console-main")).not_to_be_empty()
    for size, scheme in ((TABLET, "light"), (UPRIGHT, "dark"), (LAPTOP, "light")):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        page.emulate_media(color_scheme="dark" if scheme == "dark" else "light")
        dark = re.compile("body--dark" if scheme == "dark" else "body--light")
        expect(page.locator("body")).to_have_class(dark, timeout=WAIT_MS)
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0], (
            f"{name}: too wide for {size}"
        )


def tune(desk: Desk, page: Page) -> None:
    """Open the page Tune and wait until it shows what the left camera has, and its picture."""
    show(desk, page, "tune")
    tab = page.get_by_role("tab", name="left")
    if tab.get_attribute("aria-selected") != "true":
        tab.click()
    expect(page.get_by_label("Exposure (µs), number")).not_to_have_value("", timeout=WAIT_MS)
    page.wait_for_function("document.querySelector('.camera-view img')?.naturalWidth > 0", timeout=WAIT_MS)


def quiet(slave: FakeSlave, seconds: float) -> bool:
    """Whether nobody asks for pictures for so long."""
    asked = len(slave.verbs("preview"))
    return not until(lambda: len(slave.verbs("preview")) > asked, seconds)


def enter(page: Page, label: str, text: str, done: Callable[[], bool]) -> None:
    """Type a number until it is heard: what the page is told late may take the place of what is being typed."""

    def entered() -> bool:
        page.get_by_label(label).fill(text)
        page.keyboard.press("Enter")
        return until(done, AGAIN_S)

    assert until(entered), f"{label}: {text}"


@pytest.mark.parametrize("name", ["setup", "plots"])
def test_a_page_fits_laptop_and_tablet_and_follows_the_systems_colours(
    desk: Desk, page: Page, name: str
) -> None:
    show(desk, page, name)
    if name == "plots":
        expect(page.locator(".chart canvas").first).to_be_visible(timeout=WAIT_MS)


def test_gestures_are_described_in_words(desk: Desk, page: Page) -> None:
    show(desk, page, "gestures")
    expect(page.get_by_text("small grasp").first).to_be_visible(timeout=WAIT_MS)
    expect(page.get_by_text("index, 12 mm")).to_be_visible(timeout=WAIT_MS)


def test_live_shows_pictures_only_while_somebody_looks(desk: Desk, page: Page) -> None:
    assert until(lambda: not desk.left.shows)
    show(desk, page, "live")
    page.wait_for_function(
        "[...document.querySelectorAll('.camera-view img')].filter(one => one.naturalWidth > 0).length === 2",
        timeout=WAIT_MS,
    )
    expect(page.locator(".words")).to_contain_text("22 of 26 joints seen now", timeout=WAIT_MS)
    expect(page.locator(".words")).to_contain_text("pinch with the index finger, 12 mm apart")
    expect(page.locator(".hand-box canvas")).to_be_visible(timeout=WAIT_MS)
    page.get_by_role("switch", name="Tint what left takes for markers").click()
    assert until(lambda: any("thumb" in str(one) for one in desk.left.verbs("preview")))
    page.goto("about:blank")
    assert until(lambda: not desk.left.shows), "the looking ends with the page"
    assert until(lambda: quiet(desk.left, 2.0)), "and does not begin again"


def test_exposure_is_tuned_by_keys_alone_and_saved(desk: Desk, page: Page) -> None:
    tune(desk, page)
    for _ in range(80):  # by Tab from the top: navigation, tabs, picture, colours, and on
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.closest('[aria-label=\"Exposure (µs)\"]') !== null"):
            break
    else:
        pytest.fail("Tab never reaches the exposure")
    page.keyboard.press("ArrowRight")
    assert until(lambda: bool(desk.left.verbs("set")))
    value = desk.left.verbs("set")[-1]["exposure_us"]
    assert isinstance(value, float | int)
    assert 5000 < value < 5100, "one step"
    page.keyboard.press("Tab")
    expect(page.get_by_label("Exposure (µs), number")).to_be_focused()

    def typed() -> bool:
        page.keyboard.press("Control+A")
        page.keyboard.type("7000")
        page.keyboard.press("Enter")
        return until(lambda: desk.left.verbs("set")[-1].get("exposure_us") == 7000, AGAIN_S)

    assert until(typed), "what comes late of the step before may take the place of what is being typed"
    page.get_by_role("button", name="Save").focus()
    page.keyboard.press("Enter")
    path = desk.calibration / "cameras" / "left.json"
    assert until(lambda: load(path, CameraCalibration).exposure_us == 7000)
    problem = page.get_by_role("alert").filter(has_text="does not fit into a frame of 11111 us").first
    enter(page, "Exposure (µs), number", "20000", problem.is_visible)
    expect(page.get_by_label("Exposure (µs), number")).to_have_value("7000", timeout=WAIT_MS)
    enter(page, "Gain, number", "3", lambda: desk.left.camera.analogue_gain == 3.0)
    page.get_by_role("button", name="Revert").click()
    assert until(lambda: desk.left.camera.analogue_gain == 1.25)
    assert desk.left.camera.exposure_us == 7000, "back to what was saved"


def test_a_click_in_the_picture_picks_the_colour_at_that_pixel_of_the_whole_frame(
    desk: Desk, page: Page
) -> None:
    tune(desk, page)
    page.get_by_role("button", name="middle").click()
    at = page.locator(".camera-view img").bounding_box()
    assert at is not None
    page.mouse.click(at["x"] + 0.25 * at["width"], at["y"] + 0.5 * at["height"])
    assert until(lambda: bool(desk.left.verbs("pick")))
    commands = desk.left.verbs("pick")[-1]
    assert commands["marker"] == "middle"
    u, v = (float(str(x)) for x in str(commands["uv"]).strip("[]").split(","))
    assert abs(u - (0.25 * WIDTH - 0.5)) < 1.5
    assert abs(v - (0.5 * HEIGHT - 0.5)) < 1.5
    assert commands["t_ns"] in desk.left.shown_ns, "of the very picture that was clicked"
    expect(page.get_by_text(re.compile(r"H 4[45]–4[45], S 80–250"))).to_be_visible(timeout=WAIT_MS)
    page.locator(".camera-view").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    assert until(lambda: len(desk.left.verbs("pick")) == 2), "the same by keys"
    page.locator('[aria-label="Saturation, lowest and highest"] [tabindex="0"]').first.focus()
    page.keyboard.press("ArrowRight")
    assert until(lambda: any("markers" in one for one in desk.left.verbs("set")))
    low = desk.left.camera.markers
    assert low is not None
    assert low["middle"].hsv_low[1] == 81, "one step of the lower end"
    page.get_by_role("button", name="Forget this colour").click()
    assert until(lambda: "middle" not in (desk.left.camera.markers or {}))
    expect(page.get_by_text("no colour yet")).to_be_visible(timeout=WAIT_MS)


def test_the_filter_is_tried_on_the_master_and_saved_with_its_source(desk: Desk, page: Page) -> None:
    show(desk, page, "tune")
    page.get_by_role("tab", name="filter of desk").click()
    expect(page.get_by_label("Jitter left at rest (mm), number")).to_have_value("0.30", timeout=WAIT_MS)
    commands = lambda: any(one.verb == "filter" for one in desk.master.commands)  # noqa: E731
    enter(page, "Jitter left at rest (mm), number", "0.5", commands)
    assert '"jitter_m": 0.0005' in [one for one in desk.master.commands if one.verb == "filter"][-1].body
    page.get_by_role("button", name="Save").click()
    path = desk.calibration / "rigs" / "desk.json"
    assert until(lambda: load(path, RigCalibration).filter.jitter_m == 5e-4)
    assert load(path, RigCalibration).provenance["filter"].tool == "console"


def test_the_checklist_is_shown_with_its_fix_and_counted_in_the_header(desk: Desk, page: Page) -> None:
    show(desk, page, "checklist")
    expect(page.get_by_text("All is well")).to_be_visible(timeout=WAIT_MS)
    desk.master.items = (CheckItem("marker_unseen", "left.index", "left has not seen index.", "Turn it."),)
    expect(page.get_by_role("link", name="Checklist: 1 to do")).to_be_visible(timeout=WAIT_MS)
    expect(page.get_by_text("Turn it.")).to_be_visible(timeout=WAIT_MS)
    desk.master.items = ()
    expect(page.get_by_text("All is well")).to_be_visible(timeout=WAIT_MS)


def test_an_output_is_switched_on_in_its_file_and_a_process_sends(desk: Desk, page: Page) -> None:
    show(desk, page, "outputs")
    for one in ("VMC", "ROS 2", "LSL", "WebSocket"):
        expect(page.get_by_role("switch", name=re.compile(f"^{one}"))).to_be_visible()
    switch = page.get_by_role("switch", name=re.compile("^OSC"))
    switch.click()
    path = desk.calibration / "outputs" / "default.json"
    assert until(lambda: path.exists() and load(path, OutputSettings).osc.on)
    expect(page.get_by_text(re.compile(r"^open, \d+ sent"))).to_be_visible(timeout=3 * WAIT_MS)
    listening = listeners(desk.pid)
    assert {one.program for one in listening} == {"master console"}, "OSC is only sent"
    assert undocumented(listening, rows()) == []
    switch.click()
    assert until(lambda: not load(path, OutputSettings).osc.on)


def test_a_recording_is_played_by_its_controls(desk: Desk, page: Page) -> None:
    desk.master.extra = {"play.position_s": 4.0, "play.length_s": 20.0, "play.speed": 1.0, "play.paused": 0.0}
    show(desk, page, "outputs")

    def commands(verb: str) -> list[str]:
        return [one.body for one in desk.master.commands if one.verb == verb]

    page.get_by_role("button", name="Pause").click()
    assert until(lambda: bool(commands("pause")))
    desk.master.extra["play.paused"] = 1.0
    page.get_by_role("button", name="Resume").click()
    assert until(lambda: bool(commands("resume")))
    page.locator('[aria-label="Position in seconds"] [tabindex="0"]').press("ArrowRight")
    assert until(lambda: commands("seek") == ['{"t_s": 4.1}'])
    option = page.get_by_role("option", name="2 ×")

    def opened() -> bool:
        page.keyboard.press("Escape")
        page.get_by_role("combobox", name="Speed").click()
        page.wait_for_timeout(700)
        return option.is_visible()

    assert until(opened), "where a menu is drawn too slowly it stays hidden until it is opened again"
    option.click()
    assert until(lambda: commands("speed") == ['{"factor": 2.0}'])
    desk.master.extra = {}


def test_the_theme_is_changed_by_a_button_and_kept(desk: Desk, page: Page) -> None:
    show(desk, page, "checklist")
    page.get_by_role("button", name="Theme: auto. Change").click()
    page.get_by_role("button", name="Theme: light. Change").click()
    expect(page.locator("body")).to_have_class(re.compile("body--dark"))
    page.reload()
    expect(page.locator("body")).to_have_class(re.compile("body--dark"))
