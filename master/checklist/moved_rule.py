"""Rule that detects a moved camera.

Checks that the rays of the cameras still meet: those of a camera that was knocked miss those of the others.
"""

from collections.abc import Iterator, Mapping

from master.checklist.facts import Verdict, beyond
from master.checklist.window import Window


class MovedRule:
    """Push machine over the counters of one pipeline.

    Holds its counters of the last second.
    """

    def __init__(self) -> None:
        """Nothing was counted yet."""
        span_ns = 1_000_000_000
        self._window = Window(span_ns)
        self._cameras: tuple[str, ...] = ()

    def clear(self) -> None:
        """What was counted so far was of something else: a camera was away."""
        self._window.clear()

    def look(
        self, cameras: tuple[str, ...], markers: int, counts: Mapping[str, int], t_ns: int
    ) -> Iterator[Verdict]:
        """Judge the poses of the last second."""
        if cameras != self._cameras:
            self._cameras = cameras
            self._window.clear()
        # characters of a name in counts
        out = [counts.get(f"mostly_rejected.{name}"[:64], 0) for name in cameras]
        self._window.push(t_ns, counts.get("poses", 0), counts.get("epipolar_outliers", 0), *out)
        poses, outliers, *rejected = self._window.increase()
        least_poses = 6  # in the window: fewer are a hand that comes or goes
        enough = self._window.full and poses >= least_poses
        if len(cameras) == 2:
            share = outliers / max(poses * markers, 1)
            # share of the hand's markers whose rays miss each other, two cameras
            apart, apart_well = 0.15, 0.05
            yield _verdict(
                cameras,
                beyond(share, apart, apart_well) if enough else None,
                f"What cameras {' and '.join(cameras)} see does not fit together: the rays of"
                f" {100.0 * share:.0f} % of the markers miss each other.",
            )
            return
        for name, number in zip(cameras, rejected, strict=True):
            # share of the poses that leave most of what a camera sees out, three or more
            mostly, mostly_well = 0.5, 0.2
            yield _verdict(
                (name,),
                beyond(number / max(poses, 1), mostly, mostly_well) if enough else None,
                f"What camera {name} sees does not fit what the others see; it is left out.",
            )


def _verdict(cameras: tuple[str, ...], wrong: bool | None, sentence: str) -> Verdict:
    fix = "A camera was knocked, or has another lens: measure the places anew, `phalanx calibrate cameras stereo`."
    return Verdict("camera_moved", "-".join(cameras), wrong, sentence, fix, cameras)
