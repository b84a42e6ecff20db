"""Frames of a wrist device out of order: how many strobe cycles come through, and whether a wrong one ever does."""

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from bench.report import Row, datasets, rig_files, skipped
from bench.wrist.frames import RECORDINGS
from common.arrays import Image
from common.recording.frame_recording import Illumination, open_recording
from common.sim.wrist.record import ORDER
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import AMBIENTS, WristScene
from slave.sources import Frame
from slave.wrist.strobe import Strobe

RATE_HZ = 90.0
_SEEDS = range(40)


class Shown(NamedTuple):
    """A frame with the truth: to which cycle it belongs, and its illumination."""

    cycle: int
    lit: Illumination
    image: Image


@dataclass(frozen=True, slots=True)
class Delivered:
    """Index of a frame among those taken, and the period in which it is stated to have been taken."""

    index: int
    place: int


@dataclass(slots=True)
class Score:
    """Counts of cycles: delivered whole, kept, of wrong illumination, of two poses; margins [octaves]."""

    frames: int = 0
    whole: int = 0
    kept: int = 0
    wrong_illumination: int = 0
    mixed: int = 0
    margins: list[float] = field(default_factory=list[float])


def deliver(count: int, seed: int, share: float = 0.05, *, hidden: bool = False) -> list[Delivered]:
    """Drop, double and swap frames of a stream, each at random, starting anywhere in the cycle.

    Times and numbers go on rising. A lost frame leaves a gap in them, unless `hidden`: the strobe itself slips.
    """
    rng = np.random.default_rng(seed)
    taken = range(int(rng.integers(3)), count)
    order = _faulty(taken, rng, share)
    if hidden:
        return [Delivered(index, place) for place, index in enumerate(order)]
    places: list[int] = []
    copies, last = 0, -1
    for own in sorted(order):
        copies += own == last  # each takes a period of its own
        places.append(own + copies)
        last = own
    return [Delivered(index, place) for index, place in zip(order, places, strict=True)]


def _faulty(frames: Sequence[int], rng: np.random.Generator, share: float) -> list[int]:
    """Lose, double and delay a share of the frames each, as a faulty link does.

    A frame suffers at most one of the three; the frame that another one was swapped with suffers none.
    """
    out: list[int] = []
    held: list[int] = []
    for frame, chance in zip(frames, rng.uniform(size=len(frames)).tolist(), strict=True):
        if held:
            out += [frame, held.pop()]
        elif chance >= 3.0 * share:
            out.append(frame)
        elif chance >= 2.0 * share:
            held.append(frame)
        elif chance >= share:
            out += [frame, frame]
    return out + held


def score(shown: Sequence[Shown], delivered: Sequence[Delivered], into: Score) -> Strobe:
    """Push frames with wrong labels, and compare the cycles with the truth."""
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
        same = len({part.cycle for part in parts}) == 1
        into.wrong_illumination += not right
        into.mixed += right and not same
        into.kept += right and same
    into.frames += len(delivered)
    into.whole += _whole(shown, delivered)
    return strobe


def rendered(ambient: str, cycles: int = 60, seed: int = 0) -> list[Shown]:
    """Render unrelated poses of the standard wrist scene; in each the hand goes on moving from frame to frame."""
    rig, cameras, hand = rig_files("wrist")
    scene = WristScene.by_name(f"standard@{ambient}", rig, cameras, hand, seed)
    renderer = WristRenderer(scene, rig.cameras[0])
    spread_s = 0.9  # between them: the scene of a minute in unrelated poses
    times = [(k, spread_s * (k // 3) + (k % 3) / RATE_HZ) for k in range(3 * cycles)]
    return [Shown(k // 3, ORDER[k % 3], renderer.render(t_s, ORDER[k % 3])) for k, t_s in times]


def recorded(folder: Path) -> list[Shown]:
    """Read the frames of a recording in order, with its labels."""
    rows = open_recording(folder).frames_of("wrist")
    images = [np.asarray(cv2.imread(str(folder / row.file), cv2.IMREAD_GRAYSCALE), np.uint8) for row in rows]
    pairs = enumerate(zip(rows, images, strict=True))
    return [Shown(k // 3, row.illumination, image) for k, (row, image) in pairs]


def rows() -> Iterator[Row]:
    """Measure by light, with gaps visible and hidden; recordings where there are."""
    cv2.setNumThreads(1)
    for ambient in AMBIENTS:
        shown = rendered(ambient)
        for hidden in (False, True):
            yield from _scored(
                f"{ambient}, losses {'hidden' if hidden else 'numbered'}", [shown], hidden=hidden
            )
    data = datasets() / "wrist"
    if data.is_dir():
        yield from _scored("recordings", [recorded(data / name) for name in RECORDINGS], hidden=False)
    else:
        yield skipped("recordings", data)


def _scored(name: str, streams: Sequence[Sequence[Shown]], *, hidden: bool) -> Iterator[Row]:
    found = Score()
    for shown in streams:
        for seed in _SEEDS:
            score(shown, deliver(len(shown), seed, hidden=hidden), found)
    what = f"of {found.whole} that came whole; {found.frames} frames, 5 % each dropped, doubled, swapped"
    middle, least = (f(found.margins or [np.nan]) for f in (statistics.median, min))
    mixed = "three hidden losses in a row leave no trace in the order" if hidden else "goal 0"
    yield Row(f"{name}: cycles kept", 100.0 * found.kept / found.whole, "%", what)
    note = f"goal 0; margin: median {middle:.2f}, least {least:.2f} octaves"
    yield Row(f"{name}: of wrong illumination", found.wrong_illumination, "", note)
    yield Row(f"{name}: of two poses", found.mixed, "", mixed)


def _whole(shown: Sequence[Shown], delivered: Sequence[Delivered]) -> int:
    """How many cycles came one after another, period by period; copies of a frame may lie between."""
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
