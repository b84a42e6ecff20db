"""Contents of a motion-capture file.

Joints and markers of one hand over time, in metres.

Readers of single formats give a `PointTable`, every point of the file in the file's own names and unit; `read_motion`
(master/mocap/read.py) makes a `JointMotion` of it.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from common.arrays import Float, Int
from common.errors import RecordingError
from common.hand.model import JOINTS

Unit = Literal["m", "dm", "cm", "mm", "in"]
Side = Literal["left", "right"]
METRES: dict[Unit, float] = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}
MARKERS = ("thumb", "index", "middle", "ring", "little", "back", "back2", "back3")
POINTS = (*JOINTS, *MARKERS)
MAX_BYTES = 1 << 30


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """All points of a file, as they stand in it.

    Attributes:
        names: (N,) as the file spells them.
        t_s: (T,) [s], rising.
        position: (T, N, 3) in `unit`; NaN: not seen.
        unit: Of length; None: the file does not state it.
        ends: Those of `names` that are end sites, the end of a bone and no joint.
    """

    names: tuple[str, ...]
    t_s: Float
    position: Float
    unit: Unit | None
    ends: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class JointMotion:
    """Joints and markers of one hand.

    Attributes:
        t_ns: (T,) [ns], rising, on the clock of the file.
        names: (J,) each a WebXR joint, `palm`, or a marker of ours (`MARKERS`).
        position_m: (T, J, 3) [m], frame of the file; NaN: not seen.
        side: That the names state; None: they do not.
        source: The file.
        remarks: What was assumed, for a person.
    """

    t_ns: Int
    names: tuple[str, ...]
    position_m: Float
    side: Side | None
    source: str
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.t_ns)

    def of(self, name: str) -> Float:
        """Return the positions (T, 3) [m] of a joint or marker.

        NaN throughout where the file has none of it.
        """
        if name not in self.names:
            return np.full((len(self), 3), np.nan)
        return self.position_m[:, self.names.index(name)]


def checked_times(t_s: Float, where: str) -> Int:
    """Times [ns] of rows at (T,) [s].

    Raises:
        RecordingError: They are not finite, do not rise, or are none of seconds.
    """
    if not len(t_s):
        raise RecordingError(f"{where}: has no frame")
    max_s = 9e9  # beyond it no integer of nanoseconds has room
    if not np.isfinite(t_s).all() or np.abs(t_s).max() > max_s:
        row = int(np.argmax(~np.isfinite(t_s) | (np.abs(t_s) > max_s)))
        raise RecordingError(f"{where}: time of frame {row + 1} is {t_s[row]}: no seconds")
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    steps = np.diff(t_ns)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0))
        raise RecordingError(
            f"{where}: time goes from {t_s[row]:.9g} s at frame {row + 1} to {t_s[row + 1]:.9g} s: it must rise"
        )
    if len(steps) and float(np.median(steps)) > 0.5e9:
        raise RecordingError(
            f"{where}: frames are {np.median(steps) * 1e-9:.3g} s apart: are times not in seconds? name the column"
            " t_ms, t_us or t_ns"
        )
    return t_ns
