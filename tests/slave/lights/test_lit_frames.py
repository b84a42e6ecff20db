"""The simulated wrist device is lit by its strobe; faults of the strobe cost triples and never make a wrong one."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.errors import CameraError
from common.recording.frame_recording import Illumination
from common.sim.wrist.scene import WristScene
from slave.__main__ import main
from slave.cameras.synthetic import SyntheticCamera
from slave.commands.simulated import scene_of
from slave.lights.strobed import SimulatedStrobe, StrobedCamera, SyntheticLights, schedule_of
from slave.sources import Frame
from slave.wrist.strobe import Strobe
from tests.slave.lights.stage import (
    AMBIENT,
    CAMERA,
    FIRST_NS,
    LASER,
    LED,
    MS,
    RIG,
    ROOT,
    STROBE,
    Lateness,
    SetClock,
    StageClock,
)

pytestmark = pytest.mark.usefixtures("drawn_once")


@pytest.fixture(scope="module")
def scene() -> WristScene:
    found = scene_of(ROOT / "calib_json", RIG, "curl", 7)
    assert isinstance(found, WristScene)
    return found


def device(scene: WristScene, clock: StageClock, late: Lateness = lambda: 0) -> StrobedCamera:
    strobe = SimulatedStrobe(schedule_of(RIG, CAMERA), STROBE, late)
    source = SyntheticCamera(scene, "wrist", FIRST_NS, clock, 0, clock, clock.sleep, strobe)
    return StrobedCamera(source, CAMERA, RIG, strobe)


def taken(camera: StrobedCamera, count: int) -> list[Frame]:
    frames = [camera.read() for _ in range(count)]
    assert all(frame is not None for frame in frames)
    return [frame for frame in frames if frame is not None]


def test_frames_are_dark_until_the_camera_is_understood_and_then_lit_in_turn(scene: WristScene) -> None:
    camera = device(scene, StageClock())
    frames = taken(camera, 24)
    cycle = (AMBIENT, LASER, LED)
    illuminations = [frame.illumination for frame in frames]
    assert illuminations[:9] == [AMBIENT] * 9
    assert illuminations[12:] == [cycle[frame.seq % 3] for frame in frames[12:]]
    counts = camera.counts()
    assert counts["lights.pulses"] in (8, 9, 10)
    assert counts["lights.skipped"] == counts["lights.refused"] == 0
    camera.close()
    assert camera.read() is None


def test_late_and_skipped_pulses_cost_cycles_and_make_no_wrong_one(scene: WristScene) -> None:
    rng = np.random.default_rng(1)

    def late() -> int:
        return int(rng.choice([0, 2, 7, 13], p=[0.9, 0.05, 0.03, 0.02])) * MS

    camera, strobe = device(scene, StageClock(), late), Strobe(CAMERA.frame_rate_hz)
    cycles = [cycle for frame in taken(camera, 150) if (cycle := strobe.push(frame)) is not None]
    illuminations = {(t.ambient.illumination, t.laser.illumination, t.led.illumination) for t in cycles}
    assert illuminations == {(AMBIENT, LASER, LED)}
    assert 10 <= len(cycles) < 45
    assert camera.counts()["lights.skipped"] > 3


def test_a_light_that_smears_into_the_next_frame_is_seen_there(scene: WristScene) -> None:
    # What the strobe never does: the lights and the camera show it all the same.
    clock, switching = StageClock(), SetClock(FIRST_NS - 2 * MS)
    lights = SyntheticLights(switching)
    lights.switch(LASER)
    switching.t_ns = FIRST_NS + 11 * MS  # frame 1 is exposed from 10.1 to 12.1 ms
    lights.off()
    source = SyntheticCamera(scene, "wrist", FIRST_NS, clock, 0, clock, clock.sleep, lights)  # type: ignore[arg-type]
    first, second, third = (source.read() for _ in range(3))
    assert first is not None
    assert second is not None
    assert third is not None
    assert (first.illumination, second.illumination, third.illumination) == (LASER, LASER, AMBIENT)
    line = first.image.astype(int) - third.image
    smear = second.image.astype(int) - third.image
    assert line.max() > 100
    assert 0.3 < smear[line > 100].mean() / line[line > 100].mean() < 0.9


def test_the_lights_give_shares_of_an_exposure() -> None:
    clock = SetClock(1000)
    lights = SyntheticLights(clock)
    assert lights.during(0, 100).mostly is AMBIENT
    for t_ns, lit in ((1000, LASER), (1300, AMBIENT), (1400, LED), (1900, LASER)):
        clock.t_ns = t_ns
        lights.switch(lit)
    seen = lights.during(1200, 2200)
    assert (seen.laser, seen.led) == (pytest.approx(0.4), pytest.approx(0.5))
    assert seen.mostly is LED
    clock.t_ns = 2000
    lights.close()
    clock.t_ns = 3000
    lights.switch(LED)
    assert lights.during(2500, 4000) == type(seen)(0.0, 0.0)


def test_the_lights_follow_the_exposure_and_refuse_one_that_is_too_long(scene: WristScene) -> None:
    camera = device(scene, StageClock())
    taken(camera, 15)
    camera.tune(msgspec.structs.replace(CAMERA, exposure_us=2500.0))
    assert camera.metrics()["exposure_us"] == 2500.0
    illuminations = [frame.illumination for frame in taken(camera, 6)]
    assert illuminations == [(AMBIENT, LASER, LED)[seq % 3] for seq in range(15, 21)]
    with pytest.raises(CameraError, match=r"exposure_us 4000: needs light for 5200 us, strobe.max_pulse_us"):
        camera.tune(msgspec.structs.replace(CAMERA, exposure_us=4000.0))
    assert camera.metrics()["exposure_us"] == 2500.0


def test_recorded_frames_say_what_lit_them(tmp_path: Path) -> None:
    from common.recording.frame_recording import open_recording

    command = ["record", "--name", "wrist", "--rig", "wrist", "--calibration", str(ROOT / "calib_json")]
    sensor = ["--camera", "synthetic", "--scene", "curl", "--frames", "30", "-o", str(tmp_path / "rec")]
    assert main([*command, *sensor]) == 0
    rows = open_recording(tmp_path / "rec").frames_of("wrist")
    lit: tuple[Illumination, ...] = (AMBIENT, LASER, LED)
    assert all(row.illumination in (AMBIENT, lit[row.seq % 3]) for row in rows)
    assert {row.illumination for row in rows} == set(lit)
