"""What a strobed triple of the wrist device costs, stage by stage, from its three frames to the angles of five fingers.

On recorded triples with poses of their own where there are data sets, else on simulated ones. Every stage is taken in
turn with the baseline, on the processor time of its thread. The baseline is the line of the paper as it is usually
built: the two differences are undistorted whole, thresholded, and every finger's laser is the centroid of a connected
blob; neither fingers are separated nor tips found there.
"""

import os
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from msgspec.structs import replace

from bench.markers import Step, interleaved
from bench.row import Row
from common.arrays import Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.messages import WristDetections, encode
from common.recording.frame_recording import open_recording
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from master.estimator.wrist_pipeline import WristPipeline
from master.rig.wrist import WristSetup
from master.run.stages import StageTimes
from slave.cameras.replay import read_png
from slave.cameras.synthetic import STROBE
from slave.sources import Frame
from slave.wrist.background import lit
from slave.wrist.detector import WristFound, find
from slave.wrist.engine import NUMPY, Engine, engine_named
from slave.wrist.fingers import Fingers, separate
from slave.wrist.fingertips import fingertips
from slave.wrist.laser import laser_lines
from slave.wrist.strobe import Strobe, StrobeCycle
from slave.wrist.view import WristView

ROOT = Path(__file__).resolve().parents[1]
CYCLES, REPEATS = 25, 60
T = TypeVar("T")
BRIGHT = 24  # levels: the baseline's threshold


def rows() -> Iterator[Row]:
    """Rows of the recording or of the simulation."""
    cv2.setNumThreads(1)
    data = Path(os.environ.get("PHALANX_DATASETS", ROOT / "../shared/datasets")).resolve() / "wrist/curl"
    name = "curl, recorded" if data.is_dir() else "curl, simulated"
    rig, camera, hand, frames = recorded(data) if data.is_dir() else simulated()
    view = WristView.of(rig, camera, hand)
    cycles = [cycle for cycle in map(Strobe(camera.frame_rate_hz).push, frames) if cycle is not None]
    steps = slave_steps(camera, view, frames, cycles) | master_steps(rig, camera, view, cycles)
    took = interleaved(steps, REPEATS)
    slave, whole = took["slave"], took["slave"] + took["master"]
    for stage in steps:
        yield _time(f"{name}: {stage}", took[stage], "baseline" if stage == "baseline" else "")
    yield _time(f"{name}: triple -> five fingers, slave and master", whole, "goal <= 2000 on a PC core")
    yield Row(
        f"{name}: slave / baseline",
        float(np.median(slave) / np.median(took["baseline"])),
        "x",
        "more is found",
    )


def recorded(folder: Path) -> tuple[RigCalibration, CameraCalibration, HandProfile, list[Frame]]:
    """The first triples of a recording."""
    recording = open_recording(folder)
    rig = recording.manifest.wrist_rig()
    camera = recording.manifest.cameras[rig.cameras[0]]
    size = (camera.height_px, camera.width_px)
    frames = [
        Frame(row.seq, row.t_ns, row.t_ns, read_png(folder / row.file, size, grey=True))
        for row in recording.frames_of(camera.name)[: 3 * CYCLES]
    ]
    return rig, camera, load(folder.parents[1] / f"hands/{rig.hand}.json", HandProfile), frames


def simulated() -> tuple[RigCalibration, CameraCalibration, HandProfile, list[Frame]]:
    """Triples of a simulated curl."""
    tree = ROOT / "calib_json"
    rig = load(tree / "rigs/wrist.json", RigCalibration)
    camera = load(tree / "cameras/wrist.json", CameraCalibration)
    hand = load(tree / f"hands/{rig.hand}.json", HandProfile)
    renderer = WristRenderer(WristScene.by_name("curl", rig, {camera.name: camera}, hand), camera.name)
    times_ns = [10**9 + round(k * 1e9 / camera.frame_rate_hz) for k in range(3 * CYCLES)]
    frames = [
        Frame(k, t_ns, t_ns, renderer.render(0.2 * (k // 3), STROBE[k % 3]))
        for k, t_ns in enumerate(times_ns)
    ]
    return rig, camera, hand, frames


def slave_steps(
    camera: CameraCalibration, view: WristView, frames: list[Frame], cycles: list[StrobeCycle]
) -> dict[str, Step]:
    """The baseline, the whole of the slave, and its stages."""
    lights = [
        (lit(one.laser.image, one.ambient.image), lit(one.led.image, one.ambient.image)) for one in cycles
    ]
    fingers = [separate(led, view) for _, led in lights]
    found = [find(one, view) for one in cycles]
    with_fingers = list(zip(lights, fingers, strict=True))
    return {
        "baseline": baseline(camera, cycles),
        "slave": _slave(camera, view, frames, NUMPY),
        "of it strobe": _strobe(camera, frames),
        "of it background": _each(
            cycles,
            lambda one: (lit(one.laser.image, one.ambient.image), lit(one.led.image, one.ambient.image)),
        ),
        "of it fingers": _each(lights, lambda pair: separate(pair[1], view)),
        "of it laser": _each(with_fingers, lambda all_: laser_lines(all_[0][0], all_[1], view)),
        "of it fingertips": _each(
            list(zip(lights, found, strict=True)),
            lambda all_: fingertips(all_[0][1], all_[1].cycle.led.image, all_[1].laser.uv, view),
        ),
        "of it message": _each(found, lambda one: encode(one.message(camera.name, 1))),
    } | _with_numba(camera, view, frames, lights, with_fingers)


def _with_numba(
    camera: CameraCalibration,
    view: WristView,
    frames: list[Frame],
    lights: list[tuple[Image, Image]],
    with_fingers: list[tuple[tuple[Image, Image], Fingers]],
) -> dict[str, Step]:
    """The slave, and those of its stages that the other engine does, where numba is installed."""
    if find_spec("numba") is None:
        return {}
    engine = engine_named("numba")
    return {
        "slave --engine numba": _slave(camera, view, frames, engine),
        "of it fingers, numba": _each(lights, lambda pair: separate(pair[1], view, engine)),
        "of it laser, numba": _each(
            with_fingers, lambda all_: laser_lines(all_[0][0], all_[1], view, engine)
        ),
    }


def master_steps(
    rig: RigCalibration, camera: CameraCalibration, view: WristView, cycles: list[StrobeCycle]
) -> dict[str, Step]:
    """The whole of the master's line on the messages of the same triples, one after another as if they were live."""
    pipeline = WristPipeline(WristSetup.of(rig, camera, view.model), continuous=True, stage=StageTimes())
    found = [find(one, view) for one in cycles]
    period_ns = round(3e9 / camera.frame_rate_hz)
    sent = 0

    def step(one: WristFound) -> object:
        nonlocal sent
        sent += 1
        return pipeline.push(_at(one.message(camera.name, 1), 10**9 + sent * period_ns, 3 * sent))

    return {"master": _each(found, step)}


def baseline(camera: CameraCalibration, cycles: list[StrobeCycle]) -> Step:
    """The usual line on the next triple."""
    optics = camera.intrinsics
    assert optics is not None
    matrix = np.array([[optics.fx_px, 0.0, optics.cx_px], [0.0, optics.fy_px, optics.cy_px], [0.0, 0.0, 1.0]])
    across, down = cv2.initUndistortRectifyMap(
        matrix,
        np.array(optics.distortion),
        np.eye(3),
        matrix,
        (camera.width_px, camera.height_px),
        cv2.CV_16SC2,
    )

    def typical(one: StrobeCycle) -> Float:
        ambient = one.ambient.image
        laser, _led = (
            cv2.remap(cv2.subtract(frame.image, ambient), across, down, cv2.INTER_LINEAR)
            for frame in (one.laser, one.led)
        )
        bright = cv2.threshold(laser, BRIGHT, 255, cv2.THRESH_BINARY)[1]
        _count, _labels, sizes, centroids = cv2.connectedComponentsWithStats(bright)
        return np.asarray(centroids[np.argsort(sizes[:, cv2.CC_STAT_AREA])[-6:-1]], np.float64)

    return _each(cycles, typical)


def _slave(camera: CameraCalibration, view: WristView, frames: list[Frame], engine: Engine) -> Step:
    """Three frames into the strobe, what they make together, and its bytes."""
    strobe, endless = Strobe(camera.frame_rate_hz), _endless(camera, frames)

    def step() -> object:
        out = None
        for _ in range(3):
            cycle = strobe.push(next(endless))
            out = out if cycle is None else encode(find(cycle, view, engine=engine).message(camera.name, 1))
        return out

    return step


def _strobe(camera: CameraCalibration, frames: list[Frame]) -> Step:
    strobe, endless = Strobe(camera.frame_rate_hz), _endless(camera, frames)
    return lambda: [strobe.push(next(endless)) for _ in range(3)]


def _endless(camera: CameraCalibration, frames: list[Frame]) -> Iterator[Frame]:
    """The frames again and again, in step and in time."""
    for k, frame in enumerate(cycle(frames[: len(frames) // 3 * 3])):
        t_ns = 10**9 + round(k * 1e9 / camera.frame_rate_hz)
        yield Frame(k, t_ns, t_ns, frame.image)


def _at(message: WristDetections, t_ns: int, seq: int) -> WristDetections:
    return replace(message, t_ns=t_ns, ready_t_ns=t_ns, seq=seq)


def _each(items: list[T], run: Callable[[T], object]) -> Step:
    endless = cycle(items)
    return lambda: run(next(endless))


def _time(name: str, took: Float, note: str) -> Row:
    low, middle, high = np.percentile(took, (25.0, 50.0, 75.0)).tolist()
    spread = f"quartiles ±{(high - low) / 2.0:.0f}"
    return Row(name, middle, "us", f"{note}; {spread}" if note else spread)
