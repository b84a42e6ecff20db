"""Strobed frames of the simulated wrist device, and what a bad camera makes of them."""

from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from common.arrays import Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene, WristTruth
from slave.cameras.synthetic import STROBE
from slave.sources import Frame
from slave.wrist.led_image import WristView
from slave.wrist.strobe import lit

ROOT = Path(__file__).resolve().parents[3]
RIG = load(ROOT / "calib_json/rigs/wrist.json", RigCalibration)
CAMERA = load(ROOT / "calib_json/cameras/wrist.json", CameraCalibration)
HAND = load(ROOT / f"calib_json/hands/{RIG.hand}.json", HandProfile)
VIEW = WristView.of(RIG, CAMERA, HAND)
PERIOD_NS = 1e9 / CAMERA.frame_rate_hz
FIRST_NS = 10**9


def strobed(name: str, cycles: int, seed: int = 7, start_s: float = 0.0) -> tuple[Frame, ...]:
    """Frames of a scene, three for each triple, labelled with what lit them; nothing that senses may read the label."""
    return tuple(_frame(name, seed, start_s, seq) for seq in range(3 * cycles))


@cache
def _frame(name: str, seed: int, start_s: float, seq: int) -> Frame:
    t_ns, kind = FIRST_NS + round(seq * PERIOD_NS), STROBE[seq % 3]
    image = renderer(name, seed).render(start_s + (t_ns - FIRST_NS) * 1e-9, kind)
    return Frame(seq, t_ns, t_ns + 4_000_000, image, kind, 1000.0)


@cache
def scene(name: str, seed: int = 7) -> WristScene:
    """A scene before the simulated wrist device."""
    return WristScene.by_name(name, RIG, {"wrist": CAMERA}, HAND, seed)


@lru_cache(maxsize=4)
def renderer(name: str, seed: int = 7) -> WristRenderer:
    """What draws that scene; to make it takes as long as twenty frames."""
    return WristRenderer(scene(name, seed), "wrist")


class Seen(NamedTuple):
    """Differences of laser and LED frame of one instant to the ambient one, and the truth."""

    laser: Image
    led: Image
    truth: WristTruth


def seen_at(one: WristScene, device: WristRenderer, t_s: float) -> Seen:
    """What a device shows at scene time `t_s` [s]."""
    ambient, laser, led = (device.render(t_s, kind) for kind in STROBE)
    return Seen(lit(laser, ambient), lit(led, ambient), one.truth(t_s))


def spoiled(frames: tuple[Frame, ...], rng: np.random.Generator, share: float) -> list[Frame]:
    """The same as a bad camera gives them: a share each of dropped, doubled and swapped with the next one.

    What is swapped are the pictures (with their labels): numbers and times give nothing away. A dropped frame is a gap
    in both. A doubled one is handed over twice as it is, or comes again as a new frame and all after it are later.
    """
    given = list(frames)
    for k in np.flatnonzero(rng.random(len(given) - 1) < share):
        a, b = given[k], given[k + 1]
        given[k], given[k + 1] = _showing(a, b), _showing(b, a)
    out: list[Frame] = []
    late = 0
    for frame in given:
        if rng.random() < share:
            continue
        out.append(_later(frame, late))
        if rng.random() < share:
            late += int(rng.integers(2))
            out.append(_later(frame, late))
    return out


def _showing(place: Frame, picture: Frame) -> Frame:
    """`place` with the picture of another frame."""
    return replace(place, image=picture.image, illumination=picture.illumination)


def _later(frame: Frame, frames: int) -> Frame:
    late_ns = round(frames * PERIOD_NS)
    return replace(
        frame, seq=frame.seq + frames, t_ns=frame.t_ns + late_ns, ready_t_ns=frame.ready_t_ns + late_ns
    )
