"""The page in a real browser: the rigged hand is where the pose is, and nothing leaves this machine."""

import math
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from playwright.sync_api import Page

from common.arrays import Float
from common.calibration.output_settings import WebOutput
from common.messages import HandPose
from master.outputs.web.server import WebSink
from tests.browser import WAIT_MS, chromium
from tests.master.outputs.network.hands import hand_pose
from tests.results import object_pose

WAIT_S = 60.0
TO_WEBXR = np.array([1.0, -1.0, -1.0])

# The skin about each tip joint: how near its nearest vertex is, moved as the graphics card moves it.
SKIN = """() => {
  const { rig } = [...handView.hands.values()][0];
  const mesh = rig.group.children.find((thing) => thing.isSkinnedMesh);
  rig.group.updateWorldMatrix(true, true);
  rig.skeleton.update();
  const places = mesh.geometry.attributes.position, near = Array(5).fill(1);
  const tips = rig.bones.filter((bone) => bone.name.endsWith("-tip"));
  const vertex = rig.bones[0].position.clone();
  for (let v = 0; v < places.count; v++) {
    mesh.applyBoneTransform(v, vertex.fromBufferAttribute(places, v));
    tips.forEach((bone, j) => (near[j] = Math.min(near[j], bone.position.distanceTo(vertex))));
  }
  return near;
}"""

# Keeps the page's sockets and what it does by the clock within reach of a test.
REACH = """
globalThis.sockets = [];
globalThis.ticks = [];
globalThis.WebSocket = class extends WebSocket { constructor(...given) { super(...given); sockets.push(this); } };
const every = globalThis.setInterval;
globalThis.setInterval = (tick, ms) => (ticks.push(tick), every(tick, ms));
"""


def moving(k: int) -> HandPose:
    """A right hand that bends and turns, its joints' radii 8 mm."""
    angles = np.zeros((5, 4))
    angles[:, 1:] = np.radians([[10, 10, 10], [60, 50, 30], [40, 70, 40], [20, 40, 20], [5, 10, 5]]) * k / 20
    return hand_pose("right", angles, np.array([0.1 * k, -1.0, 0.4]), (0.02, 0.004 * k, 0.45), k)


def until(page: Page, true: str, sink: WebSink | None = None, pose: HandPose | None = None) -> Any:
    """Wait until the expression is true in the page, and give it the pose meanwhile."""
    end = time.monotonic() + WAIT_S
    while not (value := page.evaluate(true)):
        assert time.monotonic() < end, f"never: {true}"
        if sink is not None and pose is not None:
            sink.write(pose)
        page.wait_for_timeout(30)
    return value


def bones(page: Page) -> Float:
    return np.array(page.evaluate("handView.bonePositions('my-right')"), np.float64)


def test_the_page_moves_a_rigged_hand_and_asks_nobody_else(tmp_path: Path) -> None:
    sink = WebSink(WebOutput(host="127.0.0.1", port=0))
    address = f"http://127.0.0.1:{sink.server.port}/"
    asked: list[str] = []
    trouble: list[str] = []
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 640, "height": 480}, color_scheme="dark")
        page.set_default_timeout(WAIT_MS)
        page.on("request", lambda request: asked.append(request.url))
        page.on("websocket", lambda opened: asked.append(opened.url))
        page.on("console", lambda output: trouble.append(output.text) if output.type == "error" else None)
        page.on("pageerror", lambda error: trouble.append(str(error)))
        page.goto(address)
        until(page, "globalThis.handView?.hands.size === 1", sink, moving(0))

        for k in range(1, 21):
            sink.write(moving(k))
            page.wait_for_timeout(10)
        last = moving(20)
        expected = last.position_m[1:] * TO_WEBXR
        until(
            page, f"Math.abs(handView.bonePositions('my-right')[0][1] - {expected[0, 1]}) < 1e-4", sink, last
        )
        assert np.abs(bones(page) - expected).max() < 1e-4
        near = np.array(page.evaluate(SKIN))
        assert ((near > 0.5 * 0.008) & (near < 1.2 * 0.008)).all()  # the skin went along
        until(page, "document.getElementById('link').dataset.state === 'open'", sink, last)
        until(page, "document.querySelector('canvas').ariaLabel.includes('25 joints tracked')", sink, last)
        page.screenshot(path=tmp_path / "page.png")
        an_object(page, sink)
        keyboard(page)
        again(page, sink)
        page.evaluate("handView.dispose()")
        assert page.query_selector("canvas") is None
        assert {urlsplit(url).hostname for url in asked} == {"127.0.0.1"}
        assert any(url.startswith("ws://") for url in asked)
    # A browser itself reports that a connection was refused while the server was away.
    assert [text for text in trouble if "WebSocket connection to" not in text] == []


def test_a_closing_socket_is_not_asked_for_the_round_trip() -> None:
    trouble: list[str] = []
    sink = WebSink(WebOutput(host="127.0.0.1", port=0))
    try:
        with chromium() as browser:
            page = browser.new_page()
            page.set_default_timeout(WAIT_MS)
            page.on("console", lambda output: trouble.append(output.text) if output.type == "error" else None)
            page.add_init_script(REACH)
            page.goto(f"http://127.0.0.1:{sink.server.port}/")
            until(page, "sockets[0]?.readyState === WebSocket.OPEN && ticks.length >= 2")
            page.evaluate("() => { sockets[0].close(); for (const tick of ticks) tick(); }")
            until(page, "sockets[1]?.readyState === WebSocket.OPEN")
    finally:
        sink.close()
    assert trouble == []


def an_object(page: Page, sink: WebSink) -> None:
    """An object is where its pose says, turned by pi about x as the hand is."""
    where, quaternion = np.array([0.1, 0.05, 0.4]), np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    sink.write(
        object_pose("mug", where, quaternion, cov=np.full((6, 6), np.nan), residual_m=math.nan, source=2)
    )
    until(page, "handView.objects.size === 1")
    group = "handView.objects.get('mug').group"
    assert np.abs(np.array(page.evaluate(f"{group}.position.toArray()")) - where * TO_WEBXR).max() < 1e-4
    output = np.array(page.evaluate(f"{group}.quaternion.toArray()"))
    assert abs(abs(output @ [math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0]) - 1.0) < 1e-5


def keyboard(page: Page) -> None:
    """All is reached by Tab and has a name; arrows turn, + comes nearer, 0 centres."""
    eye = "handView.camera.position.clone().sub(handView.controls.target).toArray()"
    page.focus("canvas")
    start = np.array(page.evaluate(eye))
    for key in ("ArrowLeft", "ArrowUp", "+"):
        before = np.array(page.evaluate(eye))
        page.keyboard.press(key)
        assert np.linalg.norm(np.array(page.evaluate(eye)) - before) > 1e-3, key
    page.keyboard.press("0")
    back = np.array(page.evaluate(eye))
    assert np.abs(back / np.linalg.norm(back) - start / np.linalg.norm(start)).max() < 1e-3
    target = np.array(page.evaluate("handView.controls.target.toArray()"))
    assert np.linalg.norm(target - bones(page).mean(axis=0)) < 0.05
    names = page.eval_on_selector_all("button", "all => all.map(b => b.ariaLabel ?? b.textContent.trim())")
    reached: list[str] = []
    for _ in names:
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate("document.activeElement.ariaLabel ?? document.activeElement.textContent.trim()")
        )
    assert reached == names
    assert all(len(name) > 3 for name in names)
    page.keyboard.press("Enter")  # the last is the theme
    assert page.evaluate("document.documentElement.dataset.theme") == "light"


def again(page: Page, sink: WebSink) -> None:
    """The page connects again by itself when the server comes back."""
    port = sink.server.port
    sink.close()
    until(page, "document.getElementById('link').dataset.state === 'waiting'")
    back = WebSink(WebOutput(host="127.0.0.1", port=port))
    try:
        expected = moving(3).position_m[1:] * TO_WEBXR
        until(
            page,
            f"Math.abs(handView.bonePositions('my-right')[0][1] - {expected[0, 1]}) < 1e-4",
            back,
            moving(3),
        )
        until(page, "document.getElementById('link').dataset.state === 'open'", back, moving(3))
        assert np.abs(bones(page) - expected).max() < 1e-4
    finally:
        back.close()
