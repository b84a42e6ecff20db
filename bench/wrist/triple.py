"""Time of a strobe cycle of the wrist device, from its three frames to the angles of five fingers.

On recorded cycles with poses of their own where there are data sets, else on simulated ones. Every step is taken in
turn with the baseline, on the processor time of its thread. The baseline is the line of the paper as it is usually
built: the two differences are undistorted whole, thresholded, and every finger's laser is the centroid of a connected
blob; neither fingers are separated nor tips found there. `--picture FILE` draws one cycle and what is found in it.
"""

from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from msgspec.structs import replace

from bench.markers.speed import Step, interleaved, time_row
from bench.report import Row, datasets, rig_files
from bench.wrist.frames import differences, drawn, recorded
from common.arrays import Float, Image
from common.calibration import CameraCalibration
from common.hand.model import CHAINS
from common.messages import WristDetections, encode
from common.sim.wrist.scene import WristScene
from master.estimator.wrist_pipeline import WristPipeline
from master.rig.wrist import WristSetup
from master.run.app import StageTimes
from slave.sources import Frame
from slave.wrist.detector import WristFound, find
from slave.wrist.engine import NUMPY, Engine, engine_named
from slave.wrist.fingertips import fingertips
from slave.wrist.laser import laser_lines, separate
from slave.wrist.led_image import WristView
from slave.wrist.strobe import Strobe, StrobeCycle

_TRIPLES, _REPEATS = 25, 60
_BRIGHT = 24  # levels: the baseline's threshold
_PICTURE_S, _SCALE = 2.0, 0.6  # of a curl: half bent, the fingertips in view
# Okabe and Ito's colours, blue first: thumb ... little.
_FINGER_BGR = ((0, 159, 230), (233, 180, 86), (115, 158, 0), (167, 121, 204), (0, 94, 213))
T = TypeVar("T")


def rows() -> Iterator[Row]:
    """Measure the slave and the master on a recording or on a simulation."""
    cv2.setNumThreads(1)
    data = datasets() / "wrist/curl"
    if data.is_dir():
        read = recorded(data, datasets() / "hands")
        name, rig, camera, view, cycles = (
            "curl, recorded",
            read.rig,
            read.camera,
            read.view,
            read.cycles[:_TRIPLES],
        )
    else:
        rig, cameras, hand = rig_files("wrist")
        camera = cameras[rig.cameras[0]]
        name, view = "curl, simulated", WristView.of(rig, camera, hand)
        cycles = drawn(
            WristScene.by_name("curl", rig, cameras, hand), camera.name, np.arange(0.0, 0.2 * _TRIPLES, 0.2)
        )
    frames = [frame for one in cycles for frame in (one.ambient, one.laser, one.led)]
    found = [find(one, view) for one in cycles]
    lights = [differences(one) for one in cycles]
    fingers = [separate(led, view) for _, led in lights]
    both = list(zip(lights, fingers, found, strict=True))
    pipeline = WristPipeline(WristSetup.of(rig, camera, view.model), continuous=True, stage=StageTimes())
    period_ns, sent = round(3e9 / camera.frame_rate_hz), 0

    def master(one: WristFound) -> object:
        nonlocal sent
        sent += 1
        return pipeline.push(_at(one.message(camera.name, 1), 10**9 + sent * period_ns, 3 * sent))

    took = interleaved(
        {
            "baseline": _baseline(camera, cycles),
            "slave": _slave(camera, view, frames, NUMPY),
            "slave --engine numba": _slave(camera, view, frames, engine_named("numba")),
            "of it fingers": _each(lights, lambda pair: separate(pair[1], view)),
            "of it laser": _each(both, lambda all_: laser_lines(all_[0][0], all_[1], view)),
            "of it fingertips": _each(
                both, lambda all_: fingertips(all_[0][1], all_[2].cycle.led.image, all_[2].laser.uv, view)
            ),
            "master": _each(found, master),
        },
        _REPEATS,
    )
    for step, samples in took.items():
        yield time_row(f"{name}: {step}", samples)
    whole = took["slave"] + took["master"]
    yield time_row(f"{name}: cycle -> five fingers, slave and master", whole, "goal <= 2000 on a PC core")


def _baseline(camera: CameraCalibration, cycles: list[StrobeCycle]) -> Step:
    """The usual line on the next cycle."""
    optics = camera.intrinsics
    assert optics is not None
    matrix = np.array([[optics.fx_px, 0.0, optics.cx_px], [0.0, optics.fy_px, optics.cy_px], [0.0, 0.0, 1.0]])
    size, lens = (camera.width_px, camera.height_px), np.array(optics.distortion)
    across, down = cv2.initUndistortRectifyMap(matrix, lens, np.eye(3), matrix, size, cv2.CV_16SC2)

    def typical(one: StrobeCycle) -> Float:
        ambient = one.ambient.image
        laser, _led = (
            cv2.remap(cv2.subtract(frame.image, ambient), across, down, cv2.INTER_LINEAR)
            for frame in (one.laser, one.led)
        )
        bright = cv2.threshold(laser, _BRIGHT, 255, cv2.THRESH_BINARY)[1]
        _count, _labels, sizes, centroids = cv2.connectedComponentsWithStats(bright)
        return np.asarray(centroids[np.argsort(sizes[:, cv2.CC_STAT_AREA])[-6:-1]], np.float64)

    return _each(cycles, typical)


def _slave(camera: CameraCalibration, view: WristView, frames: list[Frame], engine: Engine) -> Step:
    """Three frames into the strobe, detection, and the bytes of the message."""
    strobe, endless = Strobe(camera.frame_rate_hz), _endless(camera, frames)

    def step() -> object:
        out = None
        for _ in range(3):
            cycle = strobe.push(next(endless))
            out = out if cycle is None else encode(find(cycle, view, engine=engine).message(camera.name, 1))
        return out

    return step


def _endless(camera: CameraCalibration, frames: list[Frame]) -> Iterator[Frame]:
    """The frames again and again, in step and in time."""
    for k, frame in enumerate(cycle(frames)):
        t_ns = 10**9 + round(k * 1e9 / camera.frame_rate_hz)
        yield Frame(k, t_ns, t_ns, frame.image)


def _at(message: WristDetections, t_ns: int, seq: int) -> WristDetections:
    return replace(message, t_ns=t_ns, ready_t_ns=t_ns, seq=seq)


def _each(items: list[T], run: Callable[[T], object]) -> Step:
    endless = cycle(items)
    return lambda: run(next(endless))


def picture(file: Path) -> None:
    """Draw the three frames above; below the light of laser and of LEDs alone, and the solved hand."""
    rig, cameras, hand = rig_files("wrist")
    camera = cameras[rig.cameras[0]]
    view, scene = WristView.of(rig, camera, hand), WristScene.by_name("curl", rig, cameras, hand)
    cycle = drawn(scene, camera.name, np.array([_PICTURE_S]), 1.0 / camera.frame_rate_hz)[0]
    found = find(cycle, view)
    laser, led = differences(cycle)
    lines = _titled(laser, "laser - ambient: a point on each finger")
    fingers = _titled(led, "LEDs - ambient: seams, and fingertips")
    for seam in separate(led, view).polylines():
        whole = _pixels(seam[np.isfinite(seam).all(axis=1)])
        cv2.polylines(
            fingers, [whole], isClosed=False, color=(160, 160, 160), thickness=1, lineType=cv2.LINE_AA
        )
    for image, uv, mark in (
        (lines, found.laser.uv, cv2.MARKER_CROSS),
        (fingers, found.tips.uv, cv2.MARKER_DIAMOND),
    ):
        for point, colour in zip(uv, _FINGER_BGR, strict=True):
            if np.isfinite(point).all():
                cv2.drawMarker(image, _pixels(point[None])[0, 0].tolist(), colour, mark, 14, 2, cv2.LINE_AA)
    pipeline = WristPipeline(WristSetup.of(rig, camera, view.model), continuous=False, stage=StageTimes())
    solved = [*pipeline.push(found.message(camera.name, 1)), *pipeline.flush()]
    joints, bones = (
        view.optics.project(solved[0].pose.position_m),
        _titled(led, "the hand that the master makes of it"),
    )
    for chain, colour in zip(CHAINS, _FINGER_BGR, strict=True):
        points = [_pixels(joints[chain])]
        cv2.polylines(bones, points, isClosed=False, color=colour, thickness=2, lineType=cv2.LINE_AA)
    frames = (cycle.ambient, "1: ambient light"), (cycle.laser, "2: laser"), (cycle.led, "3: LEDs")
    top = np.hstack([_titled(frame.image, title) for frame, title in frames])
    cv2.imwrite(str(file), np.vstack([top, np.hstack([lines, fingers, bones])]))


def _titled(image: Image, title: str) -> Image:
    """A grey picture in colour, scaled, brighter, with a title."""
    bright = np.clip(image.astype(np.float32) * 1.4, 0.0, 255.0).astype(np.uint8)
    size = (round(image.shape[1] * _SCALE), round(image.shape[0] * _SCALE))
    out = cv2.cvtColor(cv2.resize(bright, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    cv2.putText(out, title, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(out, np.uint8)


def _pixels(uv: Float) -> np.ndarray:
    return np.round(uv * _SCALE).astype(np.int32)[:, None]
