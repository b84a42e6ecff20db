"""The settings of a running camera: commands over the bus, changed files; what is refused changes nothing."""

import dataclasses
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, HsvRange, RigCalibration, load, save
from common.clock import SystemClock
from common.errors import BusError, CalibrationError, CameraError
from common.messages import Command, Health, MarkerDetections
from common.sim.motion import HandState
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.cameras.synthetic import SyntheticCamera
from slave.markers.reloadable import ReloadableDetector, detector_for, marker_changes
from slave.markers.white_balance import Inline
from slave.report import DetectionCounters, Reporter
from slave.sender import MarkerPipeline, run
from slave.sources import Frame, Tunable
from slave.tuning import CameraFiles, CameraTuning
from slave.uplink import Uplink
from tests.memory_bus import LoopbackBus
from tests.network_helpers import until
from tests.slave.stand_ins import Wire

pytestmark = pytest.mark.usefixtures("drawn_once")
ROOT = Path(__file__).resolve().parents[2]
RIG = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
CAMERAS = {name: load(ROOT / f"calib_json/cameras/{name}.json", CameraCalibration) for name in RIG.cameras}
HAND = load(ROOT / "calib_json/hands/default-right.json", HandProfile)
FILE = CAMERAS["left"]


class Still:
    """An open hand that stands, all its markers in view."""

    period_s = 60.0

    def __init__(self) -> None:
        self._state = Scene.standard(RIG, CAMERAS, HAND).motion.at(0.0)

    def at(self, t_s: float) -> HandState:
        del t_s
        return self._state


SCENE = Scene.of_motion(RIG, CAMERAS, HAND, Still())


def changed(**changes: Any) -> CameraCalibration:
    return msgspec.structs.replace(FILE, **changes)


def text(camera: CameraCalibration) -> str:
    return msgspec.json.encode(camera).decode()


class Knobs(Tunable):
    """A camera of which only the settings are there."""

    def __init__(self) -> None:
        self.tuned: list[CameraCalibration] = []
        self.refuses = False

    def tune(self, camera: CameraCalibration) -> None:
        if self.refuses:
            raise CameraError("exposure_us: wanted 9000 us, got 8000 us; the settings before are back")
        self.tuned.append(camera)

    def metrics(self) -> dict[str, float]:
        return {"exposure_us": (self.tuned or [FILE])[-1].exposure_us}

    def counts(self) -> dict[str, int]:
        return {"camera.lost": 2}


def tree(folder: Path) -> CameraFiles:
    """A calib_json tree of its own."""
    for part in ("cameras", "rigs"):
        (folder / part).mkdir()
    paths = folder / "cameras/left.json", folder / "rigs/desk.json"
    save(paths[0], FILE)
    save(paths[1], RIG)
    return CameraFiles(*paths, FILE, RIG)


@pytest.fixture
def knobs() -> Knobs:
    return Knobs()


@pytest.fixture
def files(tmp_path: Path) -> CameraFiles:
    return tree(tmp_path)


@pytest.fixture
def tuning(files: CameraFiles, knobs: Knobs) -> CameraTuning:
    return CameraTuning(files, knobs, None, lambda: True)


def test_set_changes_what_it_names_and_nothing_else(tuning: CameraTuning, knobs: Knobs) -> None:
    answer = tuning.commands()["set"]('{"exposure_us": 9000}')
    assert knobs.tuned == [changed(exposure_us=9000.0)]
    assert (answer["exposure_us"], answer["wanted.exposure_us"], answer["wanted.red_gain"]) == (
        9000,
        9000,
        0.83,
    )
    tuning.commands()["set"]('{"analogue_gain": 2, "colour_gains": [1.1, 1.6]}')
    assert knobs.tuned[-1] == changed(exposure_us=9000.0, analogue_gain=2.0, colour_gains=(1.1, 1.6))


@pytest.mark.parametrize(
    ("verb", "body", "expected"),
    [
        ("set", '{"exposure": 9000}', "set: Object contains unknown field `exposure`"),
        ("set", '{"exposure_us": -1}', r"set: Expected `float` >= 0.01 - at `\$.exposure_us`"),
        ("set", '{"colour_gains": [1.0]}', r"set: Expected `array` of length 2"),
        ("set", "", "set: Input data was truncated"),
        ("set", "[" * 2000, "set: "),
        ("load", "{}", "load: Object missing required field"),
        (
            "load",
            text(changed(name="right")),
            "name: left cannot become right while it runs: restart the slave",
        ),
        ("load", text(changed(width_px=320)), "width_px: 640 cannot become 320 while it runs"),
        ("load", text(changed(focus_m=0.5)), "focus_m: None cannot become 0.5 while it runs"),
        ("set", '{"roi_margin": 0.6}', r"set: Expected `float` <= 0.5 - at `\$.roi_margin`"),
        ("set", '{"markers": {"palm": null}}', "set: markers: the rig has no palm; it has thumb, index"),
        (
            "set",
            '{"exposure_us": 9000, "markers": {"index": {"hsv_low": [60, 200, 64], "hsv_high": [76, 100, 255]}}}',
            "set: markers.index: S of hsv_low is above hsv_high",
        ),
        ("pick", '{"marker": "index", "uv": [3, 4]}', "pick: this slave seeks no markers"),
        ("pick", '{"marker": "index"}', "pick: Object missing required field `uv`"),
        ("settings", "{}", "takes no body"),
        ("save", text(FILE), "takes no body"),
    ],
)
def test_a_wrong_body_is_refused_with_the_reason(
    verb: str, body: str, expected: str, tuning: CameraTuning, knobs: Knobs
) -> None:
    with pytest.raises(CalibrationError, match=expected):
        tuning.commands()[verb](body)
    assert knobs.tuned == []


def test_what_the_camera_did_not_take_is_not_in_use(
    tuning: CameraTuning, knobs: Knobs, files: CameraFiles
) -> None:
    knobs.refuses = True
    with pytest.raises(CameraError, match="wanted 9000 us, got 8000 us"):
        tuning.commands()["set"]('{"exposure_us": 9000}')
    assert tuning.commands()["settings"]("")["wanted.exposure_us"] == 5000.0
    tuning.commands()["save"]("")
    assert load(files.camera_path, CameraCalibration) == FILE


def test_a_changed_file_is_used_and_a_broken_one_is_counted_once(
    tuning: CameraTuning, knobs: Knobs, files: CameraFiles, caplog: pytest.LogCaptureFixture
) -> None:
    tuning.look()
    tuning.look()
    assert knobs.tuned == []
    save(files.camera_path, changed(exposure_us=7000.0))
    tuning.look()
    assert knobs.tuned == [changed(exposure_us=7000.0)]
    files.camera_path.write_text('{"version": 1, ')
    tuning.look()
    tuning.look()
    assert "left.json: Input data was truncated" in caplog.text
    files.camera_path.unlink()
    tuning.look()
    assert "left.json: cannot read: No such file" in caplog.text
    save(files.rig_path, msgspec.structs.replace(RIG, markers=RIG.markers[:-1]))
    save(files.camera_path, changed(exposure_us=7000.0))
    tuning.look()
    assert "give all processes of the rig the same files, then restart them" in caplog.text
    save(files.rig_path, RIG)
    tuning.look()
    counts = tuning.counts()
    assert counts == {"reload.applied": 1, "reload.refused": 3, "camera.lost": 2}
    assert len(knobs.tuned) == 1
    save(files.camera_path, changed(exposure_us=6000.0))
    tuning.look()
    assert knobs.tuned[-1].exposure_us == 6000.0


def test_what_a_command_changed_stays_until_the_file_changes(
    tuning: CameraTuning, knobs: Knobs, files: CameraFiles
) -> None:
    tuning.commands()["set"]('{"exposure_us": 9000}')
    tuning.look()
    save(files.camera_path, FILE)
    tuning.look()
    save(files.rig_path, msgspec.structs.replace(RIG, free_markers=("little",)))
    tuning.look()
    assert knobs.tuned == [changed(exposure_us=9000.0)]
    save(files.camera_path, changed(analogue_gain=2.0))
    tuning.look()
    assert knobs.tuned[-1] == changed(analogue_gain=2.0)


def test_its_own_save_is_no_change(tuning: CameraTuning, knobs: Knobs, files: CameraFiles) -> None:
    tuning.look()
    tuning.commands()["set"]('{"exposure_us": 9000}')
    tuning.look()
    tuning.commands()["save"]("")
    tuning.look()
    assert len(knobs.tuned) == 1
    assert tuning.counts()["reload.applied"] == 0
    assert load(files.camera_path, CameraCalibration) == changed(exposure_us=9000.0)


def test_files_are_not_looked_at_before_frames_come(files: CameraFiles, knobs: Knobs) -> None:
    frames: list[int] = []
    tuning = CameraTuning(files, knobs, None, lambda: bool(frames))
    save(files.camera_path, changed(exposure_us=7000.0))
    tuning.look()
    assert knobs.tuned == []
    frames.append(1)
    tuning.look()
    assert knobs.tuned == [changed(exposure_us=7000.0)]


class Slave:
    """What `phalanx-slave run` joins, with a simulated camera, on a bus inside this process."""

    def __init__(self, files: CameraFiles, stop: threading.Event) -> None:
        self.bus, self.wire, self.files = LoopbackBus(), Wire(MarkerDetections, "tcp/127.0.0.1:1"), files
        clock = SystemClock()
        self.source = SyntheticCamera(SCENE, "left", clock.now_ns(), clock, 0, clock)

        def make(camera: CameraCalibration, rig: RigCalibration) -> Any:
            return detector_for(camera, rig.markers, Inline(), free=rig.free_markers)

        self.detector = ReloadableDetector(make(FILE, RIG))
        counters = DetectionCounters(RIG.markers)
        changes = marker_changes(self.detector, make)
        self.tuning = CameraTuning(files, self.source, changes, lambda: counters.counts()["frames"] > 0)
        self.light = np.zeros(3)
        self.reporter = Reporter(
            "left",
            cast(Uplink, self.wire),
            counters,
            clock,
            lambda _: self.bus.join(),
            stop.set,
            0.05,
            parts=(self.tuning,),
        )
        pipeline = MarkerPipeline("left", 77, self.wire.send, self.detector.push, counters, self._look)
        loop = (self.source, pipeline, stop)
        self.thread = threading.Thread(target=run, args=loop)
        self.thread.start()

    def _look(self, frame: Frame) -> None:
        self.light = frame.image[:60].mean(axis=(0, 1))  # the desk: nothing moves there

    def ask(self, verb: str, body: str = "") -> Health:
        return self.bus.ask(Command("left", verb, body), 10.0)

    def seen(self) -> int:
        """Markers in the last frame."""
        return int(np.isfinite(self.wire.sent[-1].uv[:, 0]).sum()) if self.wire.sent else 0


@contextmanager
def slave(files: CameraFiles) -> Generator[Slave, None, None]:
    stop = threading.Event()
    started = Slave(files, stop)
    try:
        assert until(
            lambda: bool(started.seen() == 6 and started.light.all() and "left" in started.bus.alive()), 30.0
        )
        yield started
    finally:
        stop.set()
        started.thread.join()
        started.reporter.close()


def test_exposure_changed_over_the_bus_changes_the_picture_and_the_markers_stay(files: CameraFiles) -> None:
    with slave(files) as left:
        before = left.light.copy()
        health = left.ask("set", '{"exposure_us": 3000}')
        assert health.metrics["exposure_us"] == 3000.0
        assert until(lambda: bool((left.light < 0.9 * before).all()))
        sent = len(left.wire.sent)
        assert until(lambda: len(left.wire.sent) > sent + 20)
        assert left.seen() == 6, "the colours follow"
        with pytest.raises(
            BusError, match="'left' refused 'set': exposure_us: wanted 20000, a frame at 60 Hz"
        ):
            left.ask("set", '{"exposure_us": 20000}')
        assert left.ask("settings").metrics["exposure_us"] == 3000.0
        with pytest.raises(BusError, match="there are report, stop, settings, set, load, save"):
            left.ask("dance")


def test_a_new_calibration_goes_over_the_bus_into_the_running_slave_and_its_file(files: CameraFiles) -> None:
    """Calibration mode writes a new file: validated, atomic, equal after the round trip, in use at once."""
    assert FILE.markers is not None
    narrower = {
        name: HsvRange(
            hsv_low=(colour.hsv_low[0], colour.hsv_low[1] + 5, colour.hsv_low[2]),
            hsv_high=colour.hsv_high,
            reference_bgr_linear=colour.reference_bgr_linear,
        )
        for name, colour in FILE.markers.items()
    }
    new = changed(exposure_us=4500.0, analogue_gain=1.5, markers=narrower)
    with slave(files) as left:
        tables = left.detector
        used = tables._detector
        assert used.plain is not None
        track = used.plain._tracks
        health = left.ask("load", text(new))
        assert (health.metrics["exposure_us"], health.metrics["analogue_gain"]) == (4500.0, 1.5)
        assert load(files.camera_path, CameraCalibration) == FILE, "not asked to save"
        assert until(lambda: tables._detector is not used)
        assert tables._detector.plain is not None
        assert tables._detector.plain._tracks is track, "tracks go on"
        left.ask("save")
        assert load(files.camera_path, CameraCalibration) == new
        assert [path.name for path in files.camera_path.parent.iterdir()] == ["left.json"], (
            "nothing half written"
        )
        sent = len(left.wire.sent)
        assert until(lambda: len(left.wire.sent) > sent + 10)
        assert all(np.isfinite(m.uv[:, 0]).sum() == 6 for m in left.wire.sent[sent:])
        bad = msgspec.json.decode(text(new))
        bad["markers"].pop("index")
        with pytest.raises(BusError, match="no HSV range for index"):
            left.ask("load", msgspec.json.encode(bad).decode())
        null_detector = msgspec.json.decode(text(new))
        null_detector["markers"]["index"]["reference_bgr_linear"] = None
        with pytest.raises(BusError, match="the light is followed: restart the slave"):
            left.ask("load", msgspec.json.encode(null_detector).decode())
        assert left.ask("settings").metrics["wanted.exposure_us"] == 4500.0


def test_a_changed_file_brightens_the_picture_and_a_broken_one_is_reported(files: CameraFiles) -> None:
    with slave(files) as left:
        before = left.light.copy()
        save(files.camera_path, changed(analogue_gain=2.0))
        assert until(lambda: bool((left.light > 1.1 * before).all()))
        files.camera_path.write_text("{")
        assert until(lambda: left.ask("report").counts["reload.refused"] == 1)
        sent = len(left.wire.sent)
        assert until(lambda: len(left.wire.sent) > sent + 10), "it goes on"
        report = left.ask("report")
        assert (report.counts["reload.applied"], report.metrics["analogue_gain"]) == (1, 2.0)


def replaced(make: Callable[[], Any]) -> list[int]:
    """Markers seen in each frame while the detector is replaced in the middle."""
    renderer, detector = (
        Renderer(SCENE, "left"),
        ReloadableDetector(detector_for(FILE, RIG.markers, Inline())),
    )
    images = [(renderer.render(k / 60.0), round(k * 1e9 / 60.0)) for k in range(20)]
    counts: list[int] = []
    for k, (image, t_ns) in enumerate(images):
        if k == 10:
            feeder = threading.Timer(0.0, lambda: [detector._frames.put(images[9]) for _ in range(3)])
            feeder.start()
            detector.replace(make())
            feeder.join()
        counts.append(int(np.isfinite(detector.push(image, t_ns).uv[:, 0]).sum()))
    return counts


def test_no_frame_is_lost_for_a_detector_that_takes_over() -> None:
    counts = replaced(lambda: detector_for(FILE, RIG.markers, Inline()))
    assert min(counts[1:]) == 6, counts


def test_rate_margin_and_ranges_are_set_by_name_and_reported(tuning: CameraTuning, knobs: Knobs) -> None:
    ring = '{"hsv_low": [120, 1, 2], "hsv_high": [150, 4, 5]}'
    body = f'{{"frame_rate_hz": 30, "roi_margin": 0.1, "markers": {{"ring": {ring}}}}}'
    answer = tuning.commands()["set"](body)
    (camera,) = knobs.tuned
    assert FILE.markers is not None
    assert camera.markers is not None
    assert camera.frame_rate_hz == 30.0
    assert camera.markers["ring"].hsv_low == (120, 1, 2)
    assert camera.markers["ring"].reference_bgr_linear == FILE.markers["ring"].reference_bgr_linear
    assert {name: colour for name, colour in camera.markers.items() if name != "ring"} == {
        name: colour for name, colour in FILE.markers.items() if name != "ring"
    }
    assert (answer["roi_margin"], answer["wanted.frame_rate_hz"]) == (0.1, 30.0)
    ranges = [
        answer[f"marker.ring.{key}"] for key in ("h_low", "s_low", "v_low", "h_high", "s_high", "v_high")
    ]
    assert ranges == [120, 1, 2, 150, 4, 5]
    assert "marker.back2.h_low" not in answer, "it is no marker of this rig"
    tuning.commands()["set"]('{"markers": {"ring": null}}')
    assert "marker.ring.h_low" not in tuning.commands()["settings"]("")


def test_a_wrist_device_keeps_its_rate(files: CameraFiles, knobs: Knobs) -> None:
    rig = msgspec.structs.replace(RIG, kind="wrist")
    tuning = CameraTuning(dataclasses.replace(files, rig=rig), knobs, None, lambda: True)
    with pytest.raises(
        CalibrationError, match=r"60.0 cannot become 30.0 while laser and LEDs flash in its time"
    ):
        tuning.commands()["set"]('{"frame_rate_hz": 30}')


def test_what_others_write_into_the_file_and_what_was_set_here_are_both_kept(
    tuning: CameraTuning, files: CameraFiles
) -> None:
    """A lens is calibrated by the master, which writes it into the file, while colours are set here."""
    save(files.camera_path, bare := changed(intrinsics=None))
    tuning.look()
    tuning.commands()["set"]('{"markers": {"ring": {"hsv_low": [120, 1, 2], "hsv_high": [150, 4, 5]}}}')
    save(files.camera_path, FILE)  # the lens
    tuning.look()
    assert tuning.commands()["settings"]("")["marker.ring.h_low"] == 120
    assert load(files.camera_path, CameraCalibration) == FILE, "not asked to save"
    save(
        files.camera_path, msgspec.structs.replace(bare, row_time_us=10.0)
    )  # and once more, just before it saves
    tuning.commands()["save"]("")
    saved = load(files.camera_path, CameraCalibration)
    assert (saved.intrinsics, saved.row_time_us) == (None, 10.0)
    assert saved.markers is not None
    assert saved.markers["ring"].hsv_low == (120, 1, 2)
    assert saved.provenance["markers"].tool == "phalanx-slave set"
    assert saved.provenance["markers"].data == ("ring",)


def test_save_makes_the_file_that_is_not_there(tuning: CameraTuning, files: CameraFiles) -> None:
    files.camera_path.unlink()
    files.camera_path.parent.rmdir()
    tuning.commands()["save"]("")
    assert load(files.camera_path, CameraCalibration) == FILE


def test_a_file_or_a_load_without_a_colour_that_is_in_use_is_refused(
    files: CameraFiles, knobs: Knobs
) -> None:
    tuning = CameraTuning(files, knobs, lambda _old, _new: None, lambda: True)
    with pytest.raises(CalibrationError, match=r"no HSV range for thumb, index, .* which have one in use"):
        tuning.commands()["load"](text(changed(markers=None)))
    save(files.camera_path, changed(markers=None))
    tuning.look()
    assert tuning.counts()["reload.refused"] == 1
