"""Frozen recordings: messages as slaves send them, with files of calibration, and exact truth over time beside them."""

import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Bool, Float, Int
from common.messages import ImuSample, MarkerDetections, WristDetections
from common.recording.messages import MessageWriter
from common.recording.recorded_files import read_npz, write_npz

FROZEN = "frozen"
STEP_NS = 2_000_000
"""Between two rows of a truth that is read by linear interpolation: at 10 m/s^2 that errs by 5 um."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The hand at T moments, in the rig frame."""

    t_ns: Int  # (T,) increasing, on the clock of the messages
    joints_m: Float  # (T, 26, 3) in the order of a hand's joints; NaN: not known
    angles_rad: Float  # (T, 5, 4) in the order of `HandPose.angles_rad`; NaN: not known
    continuous: bool = True  # the hand moves from row to row; False: rows are unrelated poses
    hidden: Bool | None = None  # (T, 5) fingers of which the sensors that show them best see nothing

    def at(self, t_ns: Int) -> tuple[Float, Float]:
        """Joints (N, 26, 3) and angles (N, 5, 4) at moments (N,); NaN where there is no truth."""
        rows = np.concatenate([self.joints_m.reshape(-1, 78), self.angles_rad.reshape(-1, 20)], axis=1)
        found = self._moving(rows, t_ns) if self.continuous else self._still(rows, t_ns)
        return found[:, :78].reshape(-1, 26, 3), found[:, 78:].reshape(-1, 5, 4)

    def hidden_at(self, t_ns: Int) -> Bool:
        """Which fingers are hidden at moments (N,), by the row that is nearest: (N, 5)."""
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
        match_ns = 1_000_000
        inside = (t_ns >= self.t_ns[0] - match_ns) & (t_ns <= self.t_ns[-1] + match_ns)
        return np.where(inside[:, None], found, np.nan)

    def _still(self, rows: Float, t_ns: Int) -> Float:
        nearest = np.abs(self.t_ns - t_ns[:, None]).argmin(axis=1)
        still_ns = 50_000_000  # a pose of an unrelated frame holds at its first row or at its middle one
        near = np.abs(self.t_ns[nearest] - t_ns) <= still_ns
        return np.where(near[:, None], rows[nearest], np.nan)

    def save(self, path: Path) -> None:
        """Write it beside its recording."""
        arrays = {"t_ns": self.t_ns, "joints_m": self.joints_m, "angles_rad": self.angles_rad}
        hidden = {} if self.hidden is None else {"hidden": self.hidden}
        write_npz(path, {**arrays, **hidden, "continuous": np.array(self.continuous)})

    @classmethod
    def load(cls, path: Path) -> "Truth":
        """Read it; RecordingError: absent or broken."""
        names = ("t_ns", "joints_m", "angles_rad", "continuous")
        data = read_npz(path, names, "freeze it again", also=("hidden",))
        t_ns, hidden = data["t_ns"].astype(np.int64), data.get("hidden")
        hidden = None if hidden is None else np.asarray(hidden, np.bool_)
        return cls(t_ns, data["joints_m"], data["angles_rad"], bool(data["continuous"]), hidden)


def sets_of(out: Path) -> list[str]:
    """The sets that are frozen in a folder."""
    return sorted(path.name for path in (out / FROZEN).glob("*") if path.is_dir())


def truths_of(out: Path, name: str) -> dict[str, Truth]:
    """Truth of each recording of one set, by its name; RecordingError: absent or broken."""
    return {path.stem: Truth.load(path) for path in sorted((out / FROZEN / name).glob("*.npz"))}


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """One recording of a set."""

    name: str  # of the recording in its set
    rigs: tuple[str, ...]  # the rig that is solved, or those of one hand
    files: dict[str, bytes]  # files of calibration, by their path in a calibration tree
    messages: Sequence[MarkerDetections | WristDetections | ImuSample]  # as solved
    truth: Truth  # exact


def calibration_files(tree: Path, rig: str) -> dict[str, bytes]:
    """The files of one rig of a calibration tree, by their path in it."""
    names = [f"rigs/{rig}.json"]
    about = json.loads((tree / names[0]).read_text())
    names += [f"cameras/{camera}.json" for camera in about["cameras"]]
    names.append(f"hands/{about['hand']}.json")
    return {name: (tree / name).read_bytes() for name in names}


def freeze(out: Path, set_name: str, pieces: Iterable[Piece]) -> None:
    """Write recordings and truths of one set; what it had before goes."""
    folder = out / FROZEN / set_name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for piece in pieces:
        about = {"rigs": json.dumps(piece.rigs), "continuous": json.dumps(piece.truth.continuous)}
        writer = MessageWriter(folder / f"{piece.name}.mcap", piece.files, about)
        for message in piece.messages:
            writer.write("taken", message, getattr(message, "ready_t_ns", message.t_ns))
        writer.close()
        piece.truth.save(folder / f"{piece.name}.npz")
        print(f"{set_name}/{piece.name}: {len(piece.messages)} messages", flush=True)
