"""Job runs a calibration and reads its progress from its output.

It runs its stages one after the other. Progress is what their guided sessions print (`share_of`).
Results are written below the job's own folder, and taken over into the tree in use by `Job.use`.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from common.calibration import CameraCalibration, HandProfile, RigCalibration, parse
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError, PhalanxError
from master.calibrate.session import share_of
from master.console.local import LocalProcess, LocalProcesses
from master.console.setup.files import replace_file


def fault(lines: Iterable[str]) -> str:
    """Return the error that a failed command printed last, with what to do."""
    printed = [line.strip() for line in lines if line.strip()]
    for place, line in reversed(list(enumerate(printed))):
        if line.startswith(("phalanx: ", "phalanx-slave: ", "meet: ")):
            return " ".join([line.partition(": ")[2], *printed[place + 1 :]])
        if ": error: " in line:  # wrong usage
            return line.partition(": error: ")[2]
    return printed[-1] if printed else "it printed nothing"


_KINDS = {
    "cameras": CameraCalibration,
    "rigs": RigCalibration,
    "hands": HandProfile,
    "objects": ObjectProfile,
}


class JobState(StrEnum):
    """What became of a job."""

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


@dataclass(frozen=True, slots=True)
class Stage:
    """Commands that run at once, by process; `keyboard`: they wait for Enter."""

    title: str
    commands: dict[str, list[str]]
    keyboard: bool = False


class Job:
    """Calibration stages that run one after the other on a thread of their own."""

    def __init__(
        self,
        title: str,
        stages: Sequence[Callable[[], Stage]],
        local: LocalProcesses,
        environment: dict[str, str],
        tree: Path,
        work: Path,
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin; `stages` are each made when their turn comes.

        `use` writes into `tree`, the one in use; `work` is a new folder of this job; `ended` is called on its
        thread.

        Raises:
            CalibrationError: The folder cannot be made.
        """
        self.title, self.tree, self.work = title, tree, work
        self.state, self.error, self.stage = JobState.RUNNING, "", ""
        self.keyboard = False
        self.used: tuple[Path, ...] = ()
        self.lines: deque[str] = deque(maxlen=400)
        self._stages, self._local, self._environment, self._ended = tuple(stages), local, environment, ended
        self._stop = threading.Event()
        self._now: dict[str, LocalProcess] = {}
        self._place = 0
        self._before = _files(tree)
        try:
            work.mkdir(parents=True)
            (work / "tree").mkdir()
        except OSError as error:
            raise CalibrationError(f"{work}: cannot make this folder: {error.strerror}") from error
        self._thread = threading.Thread(target=self._run, name=f"job {title}", daemon=True)
        self._thread.start()

    @property
    def share(self) -> float | None:
        """Return the progress over all stages, 0..1; None if none is reported."""
        if self.state is JobState.DONE:
            return 1.0
        own = share_of(line for one in list(self._now.values()) for line in list(one.lines))
        if own is None:
            return None if len(self._stages) == 1 else self._place / len(self._stages)
        return (self._place + own) / len(self._stages)

    @property
    def text(self) -> list[str]:
        """Its lines so far."""
        now = list(self._now.values())
        asked = [one.prompt for one in now if one.prompt]
        return [*self.lines, *(line for one in now for line in list(one.lines)), *asked]

    @property
    def picture(self) -> Path | None:
        """A picture of the result, once there is one."""
        return min(self.work.glob("result*.png"), default=None)

    @property
    def page(self) -> Path | None:
        """Something to print, once there is."""
        return min([*self.work.glob("*.pdf"), *self.work.glob("*.svg")], default=None)

    def results(self) -> list[Path]:
        """Calibration files that it made, below its own tree."""
        return sorted((self.work / "tree").rglob("*.json"))

    def send(self, line: str = "") -> None:
        """Enter, for a command that waits for it."""
        for process in list(self._now.values()):
            process.send(line)

    def finish(self) -> None:
        """End what runs early; what it has is used by the stages that follow."""
        for process in list(self._now.values()):
            process.interrupt()

    def cancel(self) -> None:
        """End everything; nothing follows."""
        self._stop.set()

    def wait(self, seconds: float) -> JobState:
        """Wait for the end, at most so long [s]; what it is then."""
        self._thread.join(seconds)
        return self.state

    def use(self) -> tuple[Path, ...]:
        """Write the results into the tree in use and return the files written.

        Raises:
            CalibrationError: There is nothing, a file is broken, or one of the tree changed since the job
                began.
        """
        results = self.results()
        if not results:
            raise CalibrationError(f"{self.title}: there is no result to use")
        made: dict[Path, bytes] = {}
        for file in results:
            name, content = file.relative_to(self.work / "tree"), file.read_bytes()
            if (kind := _KINDS.get(name.parts[0])) is not None:
                parse(content, kind, str(file))
            there = self.tree / name
            if (there.read_bytes() if there.exists() else None) != self._before.get(name):
                raise CalibrationError(
                    f"{there}: changed since this calibration began, and would lose that; start it again"
                )
            made[there] = content
        for path, content in made.items():
            replace_file(self.tree, path, content)
        self._before = _files(self.tree)
        self.used = tuple(made)
        return self.used

    def _run(self) -> None:
        try:
            for place, make in enumerate(self._stages):
                self._place = place
                if not self._one(make()):
                    return
            self.state = JobState.DONE
        except PhalanxError as error:
            self.state, self.error = JobState.FAILED, str(error)
        finally:
            self._ended()

    def _one(self, stage: Stage) -> bool:
        """Run one stage; whether the next may follow."""
        self.stage, self.keyboard = stage.title, stage.keyboard
        self._now = {
            name: self._local.start(name, command, self._environment)
            for name, command in stage.commands.items()
        }
        while any(one.ended() is None for one in self._now.values()):
            failed = any(one.ended() not in (None, 0) for one in self._now.values())
            if failed or self._stop.wait(0.1):
                break
        self._local.stop(*self._now)
        codes = {name: one.ended() or 0 for name, one in self._now.items()}
        for one in self._now.values():
            self.lines.extend(one.lines)
        faults = [fault(self._now[name].lines) for name, code in codes.items() if code > 0]
        self._now, self.keyboard = {}, False
        if self._stop.is_set():
            self.state = JobState.CANCELLED
        elif faults:
            self.state, self.error = JobState.FAILED, "; ".join(faults)
        elif any(codes.values()):
            self.state, self.error = JobState.FAILED, f"{stage.title}: it was killed"
        return self.state is JobState.RUNNING


def _files(tree: Path) -> dict[Path, bytes]:
    paths = [path for folder in _KINDS for path in (tree / folder).glob("*.json")]
    return {path.relative_to(tree): path.read_bytes() for path in paths}
