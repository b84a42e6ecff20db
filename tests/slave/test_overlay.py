"""What is drawn on a preview: the pixels that the slave takes for a marker's, and where it found something."""

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from common.arrays import Image
from common.calibration import HsvRange
from common.errors import CalibrationError
from common.messages import Command, Preview
from common.messages.command_bodies import PreviewRequest
from slave.markers.detector import MarkerDetector
from slave.markers.reloadable import CalibratedDetector, ReloadableDetector
from slave.preview import ARM_PX, SEVERAL, MarkerOverlay, Previews, WristOverlay, contrast_of
from slave.sources import Frame
from tests.memory_bus import LoopbackBus
from tests.network_helpers import ManualClock
from tests.slave import painted
from tests.slave.painted import NAMES

PICTURE = painted.render(painted.hand())
FRAME = Frame(0, 5, 5, PICTURE)
SMALL = np.asarray(cv2.resize(PICTURE, (320, 240), interpolation=cv2.INTER_AREA), np.uint8)
AT = np.rint((painted.CENTRES + np.array([300.0, 200.0])) / 2.0).astype(int)  # in the small picture


def detector(**ranges: HsvRange) -> ReloadableDetector:
    made = ReloadableDetector(MarkerDetector(painted.camera(ranges=painted.RANGES | ranges), NAMES))
    made.push(PICTURE, FRAME.t_ns)
    return made


def test_the_pixels_of_the_markers_asked_for_change_their_hue_and_no_others() -> None:
    drawn = MarkerOverlay(detector(), NAMES).draw(SMALL, FRAME, ("index", "back"), found=False)
    for m, (u, v) in enumerate(AT):
        pair = np.array([[SMALL[v, u], drawn[v, u]]], np.uint8)
        was, now = (int(pixel[0]) for pixel in cv2.cvtColor(pair, cv2.COLOR_BGR2HSV)[0])
        assert (70 <= (now - was) % 180 <= 110) == (NAMES[m] in ("index", "back")), NAMES[m]
    far = np.ones(SMALL.shape[:2], bool)
    for m in (1, 5):
        far[AT[m][1] - 12 : AT[m][1] + 12, AT[m][0] - 12 : AT[m][0] + 12] = False
    np.testing.assert_array_equal(drawn[far], SMALL[far])


def test_each_marker_has_a_tint_of_its_own_and_colliding_ranges_are_white() -> None:
    tints = np.array([contrast_of(painted.RANGES[name]) for name in NAMES], float)
    apart = np.linalg.norm(tints[:, None] - tints, axis=-1)
    assert (apart[~np.eye(6, dtype=bool)] > 60.0).all()
    assert contrast_of(HsvRange(hsv_low=(175, 0, 0), hsv_high=(5, 255, 255))) == (255, 255, 0)  # red: cyan
    wide = HsvRange(hsv_low=(60, 80, 40), hsv_high=(100, 255, 255))
    drawn = MarkerOverlay(detector(index=wide), NAMES).draw(SMALL, FRAME, ("thumb", "index"), found=False)
    assert tuple(drawn[AT[0][1], AT[0][0]].tolist()) == SEVERAL


def test_what_was_found_in_this_very_frame_is_crossed() -> None:
    overlay = MarkerOverlay(detector(), NAMES)
    drawn = overlay.draw(SMALL, FRAME, (), found=True)
    for u, v in AT:
        assert (drawn[v, u + ARM_PX[0]] == 255).all()
        assert (drawn[v - ARM_PX[1], u] == 255).all()
        np.testing.assert_array_equal(drawn[v, u], SMALL[v, u])
    np.testing.assert_array_equal(overlay.draw(SMALL, replace_time(6), (), found=True), SMALL)


def replace_time(t_ns: int) -> Frame:
    return Frame(0, t_ns, t_ns, PICTURE)


def test_a_camera_without_colours_has_nothing_to_tint() -> None:
    none = ReloadableDetector(CalibratedDetector(replace(painted.camera(), markers=None), NAMES))
    none.push(PICTURE, FRAME.t_ns)
    np.testing.assert_array_equal(MarkerOverlay(none, NAMES).draw(SMALL, FRAME, NAMES, found=True), SMALL)


class Fingers:
    """Stands for the detector of a wrist device."""

    def found(self, t_ns: int) -> tuple[np.ndarray, np.ndarray] | None:
        nothing = np.full((4, 2), np.nan)
        both = np.vstack([[[100.0, 60.0]], nothing]), np.vstack([nothing, [[200.0, 90.0]]])
        return both if t_ns == FRAME.t_ns else None


def test_laser_points_and_tips_of_a_wrist_device_are_crossed_in_colour() -> None:
    overlay = WristOverlay(Fingers())  # type: ignore[arg-type]
    grey = np.full((240, 320), 40, np.uint8)
    frame = Frame(0, 5, 5, np.full((480, 640), 40, np.uint8))
    drawn = overlay.draw(grey, frame, (), found=True)
    laser, tip = (drawn[row, column + ARM_PX[0]].tolist() for row, column in ((30, 50), (45, 100)))
    assert laser[2] > 2 * laser[1], "red"
    assert tip[1] > 2 * tip[2], "green"
    assert (overlay.draw(grey, frame, (), found=False) == 40).all()


def shown(previews: Previews, bus: LoopbackBus, t_ns: int) -> Image:
    feed = bus.subscribe("preview")
    previews.offer(replace_time(t_ns))
    message = feed.get(60.0)
    assert isinstance(message, Preview)
    image = cv2.imdecode(np.frombuffer(message.jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, np.uint8)


def test_each_viewer_sees_what_all_have_wished_for_in_the_last_three_seconds() -> None:
    clock, bus = ManualClock(10**9), LoopbackBus()
    previews = Previews("left", clock, MarkerOverlay(detector(), NAMES))
    previews.use(bus)
    tinted: list[list[bool]] = []
    try:
        for second, body in enumerate(
            ('{"mask": ["index"]}', '{"mask": ["back"], "found": true}', "", "", "", "")
        ):
            clock.t_ns = (1 + second) * 10**9
            previews.ask(body)
            image = shown(previews, bus, clock.t_ns).astype(int)
            tinted.append([bool(np.abs(image[v, u] - SMALL[v, u]).max() > 60) for u, v in AT[[1, 5]]])
        frame = previews.shown(clock.t_ns)
        assert frame is not None
        assert frame.image is PICTURE, "kept for a click on it"
        with pytest.raises(
            CalibrationError, match="mask: camera 'left' does not look for palm; it looks for thumb"
        ):
            previews.ask('{"mask": ["palm"]}')
        with pytest.raises(CalibrationError, match="preview: Object contains unknown field `masks`"):
            previews.ask('{"masks": []}')
    finally:
        previews.close()
    yes, no = True, False
    assert tinted == [[yes, no], [yes, yes], [yes, yes], [yes, yes], [no, yes], [no, no]]


def test_a_body_is_read_as_it_was_written() -> None:
    for request in (PreviewRequest(), PreviewRequest(mask=("index",)), PreviewRequest(found=True)):
        command = Command("left", "preview", request.body())
        assert PreviewRequest.of(command.body) == request
    assert PreviewRequest().body() == ""
