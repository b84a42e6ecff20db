"""Exact truth of a frozen recording over time, and where the recordings of one place lie."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Bool, Float, Int
from common.recording.recorded_files import read_npz, write_npz

FROZEN = "frozen"
_MATCH_NS = 1_000_000
_STILL_NS = 50_000_000  # a pose of an unrelated frame holds at its first row or at its middle one
STEP_NS = 2_000_000
"""Between two rows of a truth that is read by linear interpolation: at 10 m/s^2 that errs by 5 um."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The hand at T moments, in the rig frame.

    Attributes:
        t_ns: (T,) increasing, on the clock of the messages.
        joints_m: (T, 26, 3) in the order of a hand's joints; NaN: not known.
        angles_rad: (T, 5, 4) in the order of `HandPose.angles_rad`; NaN: not known.
        continuous: The hand moves from row to row; False: rows are unrelated poses.
        hidden: (T, 5) of which fingers the sensors that show them best see nothing; None: of none.
    """

    t_ns: Int
    joints_m: Float
    angles_rad: Float
    continuous: bool = True
    hidden: Bool | None = None

    def at(self, t_ns: Int) -> tuple[Float, Float]:
        """Joints (N, 26, 3) and angles (N, 5, 4) at instants (N,); NaN where there is no truth."""
        rows = np.concatenate([self.joints_m.reshape(-1, 78), self.angles_rad.reshape(-1, 20)], axis=1)
        found = self._moving(rows, t_ns) if self.continuous else self._still(rows, t_ns)
        return found[:, :78].reshape(-1, 26, 3), found[:, 78:].reshape(-1, 5, 4)

    def hidden_at(self, t_ns: Int) -> Bool:
        """Which fingers are hidden at instants (N,), by the row that is nearest: (N, 5)."""
        if self.hidden is None:
            return np.zeros((len(t_ns), 5), np.bool_)
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, max(len(self.t_ns) - 1, 1))
        late = np.abs(self.t_ns[after - 1] - t_ns) > np.abs(self.t_ns[after] - t_ns)
        return self.hidden[after - 1 + late]

    def _moving(self, rows: Float, t_ns: Int) -> Float:
        if len(rows) == 1:
            return np.repeat(rows, len(t_ns), axis=0)
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, len(rows) - 1)
        before = self.t_ns[after - 1]
        share = ((t_ns - before) / (self.t_ns[after] - before))[:, None]
        found = (1.0 - share) * rows[after - 1] + share * rows[after]
        inside = (t_ns >= self.t_ns[0] - _MATCH_NS) & (t_ns <= self.t_ns[-1] + _MATCH_NS)
        return np.where(inside[:, None], found, np.nan)

    def _still(self, rows: Float, t_ns: Int) -> Float:
        nearest = np.abs(self.t_ns - t_ns[:, None]).argmin(axis=1)
        near = np.abs(self.t_ns[nearest] - t_ns) <= _STILL_NS
        return np.where(near[:, None], rows[nearest], np.nan)

    def save(self, path: Path) -> None:
        """Write it beside its recording."""
        arrays = {"t_ns": self.t_ns, "joints_m": self.joints_m, "angles_rad": self.angles_rad}
        hidden = {} if self.hidden is None else {"hidden": self.hidden}
        write_npz(path, {**arrays, **hidden, "continuous": np.array(self.continuous)})

    @classmethod
    def load(cls, path: Path) -> "Truth":
        """Read it.

        Raises:
            RecordingError: It is not there, or broken.
        """
        names = ("t_ns", "joints_m", "angles_rad", "continuous")
        data = read_npz(path, names, "freeze it again", also=("hidden",))
        t_ns, hidden = data["t_ns"].astype(np.int64), data.get("hidden")
        hidden = None if hidden is None else np.asarray(hidden, np.bool_)
        return cls(t_ns, data["joints_m"], data["angles_rad"], bool(data["continuous"]), hidden)


def sets_of(out: Path) -> list[str]:
    """The sets that are frozen in a folder."""
    return sorted(path.name for path in (out / FROZEN).glob("*") if path.is_dir())


def truths_of(out: Path, name: str) -> dict[str, Truth]:
    """Truth of each recording of one set, by its name.

    Raises:
        RecordingError: As of `Truth.load`.
    """
    return {path.stem: Truth.load(path) for path in sorted((out / FROZEN / name).glob("*.npz"))}
