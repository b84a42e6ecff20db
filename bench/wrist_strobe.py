"""Frames of a wrist device out of order: how many triples come through, and whether a wrong one ever does."""

import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from bench.row import Row, median_us
from common.arrays import Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.recording.frame_recording import Illumination, open_recording
from common.sim.wrist.record import ORDER, with_faults
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import AMBIENTS, WristScene
from slave.sources import Frame
from slave.wrist.strobe import Strobe

_ROOT = Path(__file__).resolve().parents[1]
_RECORDINGS = ("curl", "mcp", "spread", "left_small")
RATE_HZ = 90.0
FAULTS = 0.05  # each of dropped, doubled, swapped
CYCLES = 60  # rendered per light
SPREAD_S = 0.9  # between them: the scene of a minute in unrelated poses
SEEDS = range(40)


class Shown(NamedTuple):
    """A frame with the truth: which triple it belongs to, and what lit it."""

    cycle: int
    lit: Illumination
    image: Image


@dataclass(frozen=True, slots=True)
class Delivered:
    """Index of a frame among those taken, and the period in which it is said to have been taken."""

    index: int
    place: int


@dataclass(slots=True)
class Score:
    """What came through: whole triples delivered, those kept, of wrong kinds, of two poses; margins [octaves]."""

    frames: int = 0
    whole: int = 0
    kept: int = 0
    wrong_illumination: int = 0
    mixed: int = 0
    margins: list[float] = field(default_factory=list[float])


def deliver(count: int, seed: int, share: float = FAULTS, *, hidden: bool = False) -> list[Delivered]:
    """Frames of a stream dropped, doubled, swapped, each at random, starting anywhere in the cycle.

    Times and numbers go on rising. What is lost leaves a gap in them, unless `hidden`: then nothing tells of it, as
    where the strobe itself slips.
    """
    rng = np.random.default_rng(seed)
    taken = range(int(rng.integers(3)), count)
    order = with_faults(taken, rng, share, share, share)
    if hidden:
        return [Delivered(index, place) for place, index in enumerate(order)]
    places: list[int] = []
    copies, last = 0, -1
    for own in sorted(order):
        copies += own == last  # each takes a period of its own
        places.append(own + copies)
        last = own
    return [Delivered(index, place) for index, place in zip(order, places, strict=True)]


def score(shown: Sequence[Shown], delivered: Sequence[Delivered], into: Score) -> Strobe:
    """Push what was delivered, with labels that are wrong, and hold what comes out against the truth."""
    strobe = Strobe(RATE_HZ)
    of: dict[int, Shown] = {}
    for number, one in enumerate(delivered):
        t_ns = round(one.place * 1e9 / RATE_HZ)
        frame = Frame(one.place, t_ns, t_ns, shown[one.index].image, ORDER[number % 2])
        of[t_ns] = shown[one.index]
        cycle = strobe.push(frame)
        if cycle is None:
            continue
        into.margins.append(strobe.margin)
        parts = [of[part.t_ns] for part in (cycle.ambient, cycle.laser, cycle.led)]
        right = [part.lit for part in parts] == list(ORDER)
        one = len({part.cycle for part in parts}) == 1
        into.wrong_illumination += not right
        into.mixed += right and not one
        into.kept += right and one
    into.frames += len(delivered)
    into.whole += _whole(shown, delivered)
    return strobe


def rendered(ambient: str, cycles: int = CYCLES, seed: int = 0) -> list[Shown]:
    """Unrelated poses of the standard wrist scene in one light; in each the hand goes on moving from frame to frame."""
    rig = load(_ROOT / "calib_json/rigs/wrist.json", RigCalibration)
    cameras = {
        name: load(_ROOT / f"calib_json/cameras/{name}.json", CameraCalibration) for name in rig.cameras
    }
    hand = load(_ROOT / f"calib_json/hands/{rig.hand}.json", HandProfile)
    renderer = WristRenderer(
        WristScene.by_name(f"standard@{ambient}", rig, cameras, hand, seed), rig.cameras[0]
    )
    times = [(k, SPREAD_S * (k // 3) + (k % 3) / RATE_HZ) for k in range(3 * cycles)]
    return [Shown(k // 3, ORDER[k % 3], renderer.render(t_s, ORDER[k % 3])) for k, t_s in times]


def recorded(folder: Path) -> list[Shown]:
    """Frames of a recording in order, with its labels."""
    rows = open_recording(folder).frames_of("wrist")
    images = [np.asarray(cv2.imread(str(folder / row.file), cv2.IMREAD_GRAYSCALE), np.uint8) for row in rows]
    return [
        Shown(k // 3, row.illumination, image)
        for k, (row, image) in enumerate(zip(rows, images, strict=True))
    ]


def rows() -> list[Row]:
    """Rows by light, with gaps told and hidden; of the recordings where they are; time per frame."""
    cv2.setNumThreads(1)
    out: list[Row] = []
    shown: list[Shown] = []
    for ambient in AMBIENTS:
        shown = rendered(ambient)
        for hidden in (False, True):
            out += _scored(f"{ambient}, losses {'hidden' if hidden else 'told'}", [shown], hidden=hidden)
    data = Path(os.environ.get("PHALANX_DATASETS", _ROOT / "../shared/datasets")).resolve() / "wrist"
    if data.is_dir():
        out += _scored("recordings", [recorded(data / name) for name in _RECORDINGS], hidden=False)
    else:
        out.append(Row("recordings skipped", 0.0, "", f"none at {data}: set PHALANX_DATASETS"))
    return out + _times(shown)


def _scored(name: str, streams: Sequence[Sequence[Shown]], *, hidden: bool) -> list[Row]:
    found = Score()
    for shown in streams:
        for seed in SEEDS:
            score(shown, deliver(len(shown), seed, hidden=hidden), found)
    what = f"of {found.whole} that came whole; {found.frames} frames, 5 % each dropped, doubled, swapped"
    middle, least = (f(found.margins or [np.nan]) for f in (statistics.median, min))
    margins = f"margin: median {middle:.2f}, least {least:.2f} octaves"
    mixed = "three hidden losses in a row leave no trace in the order" if hidden else "goal 0"
    return [
        Row(f"{name}: triples kept", 100.0 * found.kept / found.whole, "%", what),
        Row(f"{name}: of wrong kinds", found.wrong_illumination, "", f"goal 0; {margins}"),
        Row(f"{name}: of two poses", found.mixed, "", mixed),
    ]


def _times(shown: Sequence[Shown]) -> list[Row]:
    """Median time of a push over whole cycles."""
    strobe = Strobe(RATE_HZ)
    place = 0

    def cycle() -> None:
        nonlocal place
        for _ in ORDER:
            t_ns = round(place * 1e9 / RATE_HZ)
            strobe.push(Frame(place, t_ns, t_ns, shown[place % len(shown)].image))
            place += 1

    middle, spread = median_us(cycle)
    return [Row("per frame", middle / 3, "us", f"+- {spread / 3:.0f}; goal 200")]


def _whole(shown: Sequence[Shown], delivered: Sequence[Delivered]) -> int:
    """How many triples came one after another, period by period; copies of a frame may lie between."""
    first: list[tuple[int, int, int]] = []  # index, first and last place
    for one in delivered:
        begin = one.place
        if first and first[-1][0] == one.index:
            begin = first.pop()[1]
        first.append((one.index, begin, one.place))
    return sum(
        shown[a].lit is ORDER[0]
        and (b, c) == (a + 1, a + 2)
        and begin - end == 1
        and next_begin - next_end == 1
        for (a, _, end), (b, begin, next_end), (c, next_begin, _) in zip(
            first, first[1:], first[2:], strict=False
        )
    )
