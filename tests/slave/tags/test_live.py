"""Tags in the loop of a live slave: after the markers, as often as time allows; nothing of it where none has tags."""

import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from bench.objects.tags import Look, tag_picture
from common.arrays import Image
from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.object_profile import ObjectProfile, Tag, Tags
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections, Message, TagDetections
from common.recording.frame_recording import FrameRow, Illumination
from slave.markers.detector import Detections
from slave.report import DetectionCounters
from slave.sender import MarkerPipeline, run
from slave.sources import Frame
from slave.tags.offline import SHARE, LiveTags, SearchBudget, TagCollector, finder_of, tagged_objects

ROOT = Path(__file__).resolve().parents[3]
FILE = load(ROOT / "calib_json/cameras/left.json", CameraCalibration)
RIG = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
HERE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
BOX = ObjectProfile(
    version=1, name="box", tags=Tags("aruco_5x5_100", (Tag(id=5, edge_m=0.03, T_object_tag=HERE),))
)
BARE = ObjectProfile(version=1, name="bare", tracker="vive")
MS = 1_000_000


def picture() -> Image:
    camera = CameraModel.of(FILE, np.eye(4))
    return tag_picture(np.random.default_rng(3), camera, "aruco_5x5_100", 5, 0.03, Look(0.4))[0]


class Wire:
    """Stands for camera and uplink: gives frames, keeps what is sent."""

    session = 77

    def __init__(self, frames: list[Frame]) -> None:
        self.frames, self.sent = frames, list[Message]()

    def read(self) -> Frame | None:
        return self.frames.pop(0) if self.frames else None

    def close(self) -> None:
        self.frames = []

    def send(self, message: Message) -> None:
        self.sent.append(message)


def test_the_tags_of_a_frame_follow_its_markers() -> None:
    image, tags, counters = picture(), LiveTags(FILE, [BARE, BOX]), DetectionCounters(RIG.markers)
    wire = Wire([Frame(4, 16 * MS, 16 * MS + 5, image, t_sigma_ns=9.0)])
    run(
        wire,
        MarkerPipeline(
            "left",
            wire.session,
            wire.send,
            lambda _image, _t_ns: Detections.none(len(RIG.markers)),
            counters,
            tags=tags.push,
        ),
        threading.Event(),
    )
    markers, seen = wire.sent
    assert isinstance(markers, MarkerDetections)
    assert isinstance(seen, TagDetections)
    assert (seen.camera, seen.session, seen.seq, seen.t_ns, seen.ready_t_ns, seen.t_sigma_ns) == (
        "left", 77, 4, 16 * MS, 16 * MS + 5, 9.0,
    )  # fmt: skip
    assert seen.ids.tolist() == [5]
    assert tags.counts().items() >= {"tags.searched": 1, "tags.skipped": 0, "tags.found": 1}.items()


def test_without_tags_nothing_is_sent_counted_or_loaded() -> None:
    tags = LiveTags(FILE, [BARE])
    assert tags.push(Frame(0, 0, 0, picture()), 1, 0) is None
    assert tags.counts() == {}
    code = (
        "import sys, slave.live, slave.commands.offline, slave.__main__;"
        "heavy = 'slave.tags.finder', 'common.geometry.tag_family';"
        "sys.exit(any(n in sys.modules for n in heavy))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_another_finder_takes_over() -> None:
    tags = LiveTags(FILE, [])
    tags.replace(finder_of(FILE, [BOX]))
    seen = tags.push(Frame(0, 0, 0, picture()), 1, 0)
    assert seen is not None
    assert seen.ids.tolist() == [5]
    tags.replace(None)
    assert tags.push(Frame(1, MS, MS, picture()), 1, 0) is None


@pytest.mark.parametrize(("markers_ms", "search_ms", "each"), [(2, 3, 1), (5, 3, 1), (5, 8, 3), (8, 3, 25)])
def test_markers_and_tags_stay_within_their_share(markers_ms: int, search_ms: int, each: int) -> None:
    # At 100 Hz 8 of 10 ms may be used: of 5 for the markers 3 are left, a search of 8 fits in every third frame.
    budget, searched = SearchBudget(100.0), 0
    for k in range(300):
        if budget.grants(10 * k * MS, markers_ms * MS):
            searched += 1
            budget.took(search_ms * MS)
    used_ms = markers_ms * 300 + search_ms * searched
    if markers_ms < 10 * SHARE:
        assert used_ms <= 300 * 10 * SHARE + search_ms
    assert searched >= 300 // each - 2
    assert searched <= 300 // each + 2


def test_markers_that_take_all_the_time_leave_tags_four_searches_a_second() -> None:
    # 15 of 16.7 ms for a minute, then 5 of them: no debt is left, and every frame is searched again soon.
    budget, busy, idle = SearchBudget(60.0), 0, 0
    for k in range(3660):
        spent_ms = 15 if k < 3600 else 5
        if budget.grants(round(k * 1e9 / 60), spent_ms * MS):
            busy, idle = (busy + 1, idle) if k < 3600 else (busy, idle + 1)
            budget.took(4 * MS)
    assert 60 * 4 - 20 <= busy <= 60 * 4 + 1
    assert idle >= 55


def test_frames_that_come_rarely_are_all_searched() -> None:
    # A camera of 60 Hz whose slave sees every sixth frame has the time of all six.
    budget = SearchBudget(60.0)
    searched = 0
    for k in range(100):
        if budget.grants(100 * k * MS, 30 * MS):
            searched += 1
            budget.took(20 * MS)
    assert searched >= 99


def test_a_recording_gives_its_tags_row_by_row() -> None:
    image, empty = picture(), np.full((480, 640, 3), 99, np.uint8)
    for continuous in (True, False):
        collector = TagCollector(FILE, {"box": BOX}, continuous)
        for k, shown in enumerate([image, empty, image]):
            collector.push(shown, FrameRow("left", 2 * k, k * 16 * MS, Illumination.NONE, "x.png"))
        found = collector.all()
        assert (found.seq.tolist(), found.ids.tolist(), found.row.tolist()) == ([0, 2, 4], [5, 5], [0, 2])
        assert (found.uv.shape, found.sigma_px.shape) == ((2, 4, 2), (2,))
    nothing = TagCollector(FILE, {"box": BOX}).all()
    assert (nothing.t_ns.shape, nothing.ids.shape, nothing.uv.shape) == ((0,), (0,), (0, 4, 2))


def test_objects_come_from_the_recording_or_the_files() -> None:
    import msgspec

    rig = msgspec.structs.replace(RIG, objects=("box", "bare"))
    assert list(tagged_objects({"box": BOX, "bare": BARE}, rig, None)) == ["box"]
    with pytest.raises(CalibrationError, match="'bare' of rig 'desk' is missing"):
        tagged_objects({"box": BOX}, rig, None)
    cube = msgspec.structs.replace(RIG, objects=("cube",))
    assert list(tagged_objects({}, cube, ROOT / "calib_json")) == ["cube"]
