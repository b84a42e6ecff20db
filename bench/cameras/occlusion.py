"""Finger tips that no two cameras see, in the six poses of the Digits study: one pair, and a second pair aside.

A tip is *unseen* when fewer than two cameras see it: nothing triangulates it then (Kalbfleisch, section X). Counted by
exact visibility in the renderer.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np

from bench.played import shown_by
from bench.report import CALIBRATION, Row
from common.arrays import Bool, Int
from common.calibration import HandProfile, load
from common.sim.scene import Scene
from common.sim.scenes import scene_by_name
from master.rig.setup import load_setup

FOUR = ("left", "right", "left2", "right2")  # the first two are the pair
SEEN = 0.15
"""Discs of its cap's radius that a tip must show to be seen: there the detector finds nine of ten."""
_PERIOD_S, _FRAME_HZ = 60.0, 30.0
_EXACT = (("right", 7), ("right", 21), ("left", 7), ("left", 21))


@dataclass(frozen=True, slots=True)
class Unseen:
    """Shares: tips unseen, of all tips at all moments; moments with any tip unseen; tips by no, by one camera seen."""

    tips: float
    moments: float
    none: float
    one: float

    @classmethod
    def of(cls, cameras: Int) -> "Unseen":
        """Count, from the number of cameras (T, 5) that see each tip."""
        lost, none, one = cameras < 2, cameras == 0, cameras == 1
        return cls(*(float(share.mean()) for share in (lost, lost.any(axis=1), none, one)))


def rows() -> Iterator[Row]:
    """Measure exact visibility, with one pair and with two."""
    ratios: list[float] = []
    for side, seed in _EXACT:
        scene = _scene_of(side, seed)
        seen = _seen(scene, FOUR, 4.0)
        pair, four = Unseen.of(seen[:2].sum(axis=0)), Unseen.of(seen.sum(axis=0))
        ratios.append(four.tips / pair.tips)
        note = (
            f"one pair {100 * pair.tips:.1f}; no camera {100 * four.none:.1f} ({100 * pair.none:.1f}), "
            f"one {100 * four.one:.1f} ({100 * pair.one:.1f})"
        )
        yield Row(f"{side} hand, seed {seed}: tips unseen, by visibility", 100.0 * four.tips, "%", note)
        yield Row(
            "  moments with any tip unseen", 100.0 * four.moments, "%", f"one pair {100 * pair.moments:.1f}"
        )
    yield Row("two pairs / one, tips unseen, worst of these", max(ratios), "x", "goal 0.5")


def _scene_of(side: str, seed: int) -> Scene:
    """The scene `poses` of one hand before the rig desk4, all its cameras at one rate."""
    file = CALIBRATION / f"hands/default-{side}.json"
    setup, hand = load_setup(CALIBRATION, "desk4", file), load(file, HandProfile)
    cameras = {n: msgspec.structs.replace(c, frame_rate_hz=_FRAME_HZ) for n, c in setup.cameras.items()}
    return scene_by_name("poses", setup.rig, cameras, hand, seed)


def _seen(scene: Scene, cameras: tuple[str, ...], rate_hz: float) -> Bool:
    """(C, T, 5) whether each camera sees each tip, at moments through the whole scene."""
    times = (np.arange(_PERIOD_S * rate_hz) + 0.5) / rate_hz
    return np.array([shown_by(scene, name, times)[:, :5] >= SEEN for name in cameras])
