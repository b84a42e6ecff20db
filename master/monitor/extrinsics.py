"""Live check of the camera extrinsics while the master runs.

It reports a camera whose rays miss those of the others: the camera was knocked, or is not the one of its file.
"""

from collections.abc import Mapping


class ExtrinsicsMonitor:
    """Monitor of cameras whose rays are rejected.

    Belongs to the thread that reports. Holds the last counts, and for how many looks each camera was rejected.
    """

    def __init__(self, cameras: tuple[str, ...]) -> None:
        """Watch the cameras of a rig."""
        self._rejected = dict.fromkeys(cameras, 0)
        self._looks = dict.fromkeys(cameras, 0)
        self._poses = 0

    def look(self, counts: Mapping[str, int]) -> list[str]:
        """Return a line for each camera that has been rejected for a while.

        Called once a second. The camera was rejected from most poses; it is reported once, until the condition ends.

        Args:
            counts: Of the pipeline since its start.
        """
        lines: list[str] = []
        poses = counts.get("poses", 0) - self._poses
        self._poses += poses
        for name, before in self._rejected.items():
            # characters of a name in `Health`
            now = counts.get(f"mostly_rejected.{name}"[:64], 0)
            mostly = poses > 0 and now - before > 0.5 * poses
            self._rejected[name] = now
            self._looks[name] = self._looks[name] + 1 if mostly else 0
            looks = 5  # in a row, once a second: somebody who reaches before a camera is no knock
            if self._looks[name] == looks:
                lines.append(
                    f"camera {name}: its rays miss those of the others and are left out: it was knocked, or it is not"
                    " the camera of its file: calibrate it anew, `phalanx calibrate cameras stereo --help`"
                )
        return lines
