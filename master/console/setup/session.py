"""Session holds the plan, processes and finished steps of a set-up.

What is done, to do or stale is derived from the files alone (`steps_of`). One session for all windows of a
console, with the cameras, master and calibrations that the page started. Its methods wait for processes: call
them off the event loop.
"""

import functools
import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError, PhalanxError
from common.messages.streams import MASTER
from master.console.local import LocalProcess
from master.console.setup.commands import Commands, Value, epoch_of
from master.console.setup.files import KEY_FILE, Plan, load_plan, plan_of_rig, write_cameras, write_rig
from master.console.setup.job import Job, JobState, Stage, fault
from master.console.setup.wizards import Wizard, recording_stages
from master.console.state import ConsoleState


class Done(StrEnum):
    """Whether a step is done."""

    DONE = "done"
    TO_DO = "to do"
    STALE = "stale"


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the set-up: key, title, state, and where the state comes from."""

    key: str
    title: str
    state: Done
    why: str


def steps_of(tree: Path, plan: Plan, *, keyed: bool = False) -> tuple[Step, ...]:
    """Return the steps whose results are files; `keyed`: the tree needs no key."""
    cameras: dict[str, CameraCalibration] = {}
    rig, broken, rig_broken = None, "", ""
    try:
        for camera in plan.cameras:
            path = tree / "cameras" / f"{camera.name}.json"
            if path.exists():
                cameras[camera.name] = load(path, CameraCalibration)
    except CalibrationError as error:
        broken = str(error)
    try:
        path = tree / "rigs" / f"{plan.rig}.json"
        rig = load(path, RigCalibration) if path.exists() else None
    except CalibrationError as error:
        rig_broken = str(error)
    return (
        Step("cameras", "Choose cameras", *_chosen(plan, cameras, broken)),
        Step("rig", "Markers and hand", *_named(tree, plan, rig, rig_broken, keyed=keyed)),
        Step("lens", "Lenses and places", *_measured(plan, cameras, rig)),
        Step("colours", "Colours of the markers", *_coloured(plan, cameras, rig)),
    )


def _chosen(plan: Plan, cameras: Mapping[str, CameraCalibration], broken: str) -> tuple[Done, str]:
    if broken:
        return Done.STALE, f"{broken}; write the cameras again"
    if missing := [camera.name for camera in plan.cameras if camera.name not in cameras]:
        return Done.TO_DO, f"no file of {', '.join(missing)}"
    sizes = [f"{name} {file.width_px} x {file.height_px}" for name, file in cameras.items()]
    return (Done.DONE, ", ".join(sizes)) if sizes else (Done.TO_DO, "how many cameras, and which?")


def _named(
    tree: Path, plan: Plan, rig: RigCalibration | None, error: str, *, keyed: bool
) -> tuple[Done, str]:
    if error:
        return Done.STALE, f"{error}; write rig and hand again"
    if rig is None:
        return Done.TO_DO, "which markers, whose hand?"
    if not keyed and not (tree / KEY_FILE).exists():
        return Done.TO_DO, "the rig has no key yet: write rig and hand"
    if rig.cameras != tuple(camera.name for camera in plan.cameras):
        return Done.STALE, f"its cameras are {', '.join(rig.cameras)}: write rig and hand again"
    try:
        hand = load(tree / "hands" / f"{rig.hand}.json", HandProfile)
    except PhalanxError as fault:
        return Done.STALE, f"{fault}; write rig and hand again"
    return Done.DONE, f"rig {rig.name}: {len(rig.markers)} markers, {hand.side} hand"


def _measured(
    plan: Plan, cameras: Mapping[str, CameraCalibration], rig: RigCalibration | None
) -> tuple[Done, str]:
    names = [camera.name for camera in plan.cameras]
    dark = [name for name in names if name not in cameras or cameras[name].intrinsics is None]
    if rig is None or not names or dark:
        return Done.TO_DO, f"no lens yet: {', '.join(dark)}" if dark else "show a board to the cameras"
    unplaced = [name for name in names if name not in rig.T_rig_camera]
    if unplaced:
        return Done.TO_DO, f"no place yet: {', '.join(unplaced)}"
    placed = rig.provenance.get("T_rig_camera")
    for name in names:
        lens = cameras[name].provenance.get("intrinsics")
        # The places of one command carry the second in which they were written, its lenses the one before at most.
        if placed is not None and lens is not None and lens.date > placed.date:
            return Done.STALE, f"the lens of {name} is newer than the places: measure them again"
    how = "" if placed is None else f", {placed.residual.get('rms_px', 0.0):.2f} px"
    return Done.DONE, f"{len(names)} cameras{how}"


def _coloured(
    plan: Plan, cameras: Mapping[str, CameraCalibration], rig: RigCalibration | None
) -> tuple[Done, str]:
    if rig is None or not plan.cameras:
        return Done.TO_DO, "click on each marker"
    for camera in plan.cameras:
        file = cameras.get(camera.name)
        known = {} if file is None or file.markers is None else file.markers
        if missing := [name for name in rig.markers if name not in known]:
            return Done.TO_DO, f"{camera.name} has no colour of {', '.join(missing)}"
    return Done.DONE, f"{len(rig.markers)} markers in {len(plan.cameras)} cameras"


_LOG = logging.getLogger(__name__)
WORK = Path("console") / "work"
LENS = "lens"  # the job of the main line: capture, then stereo


class Session:
    """Set-up session: plan, last step, view of simulated cameras, jobs by command."""

    def __init__(self, state: ConsoleState) -> None:
        """Go on where the files of the console's tree are.

        Raises:
            CalibrationError: The plan's file is broken.
        """
        self.state = state
        self.plan = _plan(state)
        self.view = "still"
        self.here = ""
        self.jobs: dict[str, Job] = {}
        self._lock = threading.RLock()
        self._bring_back = (False, False)  # cameras, master: what a job that borrows them found running

    @property
    def tree(self) -> Path:
        """The calib_json tree."""
        return self.state.settings.calibration

    @property
    def commands(self) -> Commands:
        """Command lines of the plan as it is now."""
        return Commands(self.state.settings, self.plan)

    @property
    def cameras_running(self) -> dict[str, LocalProcess]:
        """Slaves of this console that run."""
        names = {f"camera {camera.name}" for camera in self.plan.cameras}
        return {name: one for name, one in self.state.local.running().items() if name in names}

    @property
    def master(self) -> LocalProcess | None:
        """This console's running master: it tracks, only meets cameras, or calibrates."""
        return self.state.local.running().get(MASTER)

    @property
    def foreign_master(self) -> bool:
        """Whether a master tracks that the console did not start."""
        return self.master is None and MASTER in self.state.alive

    def steps(self) -> tuple[Step, ...]:
        """The steps whose results are files."""
        return steps_of(self.tree, self.plan, keyed=self.state.settings.key is not None)

    def failures(self) -> list[str]:
        """What ended by itself though it should run, and why."""
        faults: list[str] = []
        for name in (*(f"camera {camera.name}" for camera in self.plan.cameras), MASTER):
            process = self.state.local.get(name)
            if process is not None and process.ended() not in (None, 0) and not process.stopped:
                faults.append(f"{name} ended: {fault(process.lines)}")
        return faults

    def choose_cameras(self, plan: Plan) -> None:
        """Write camera files; a rig that is there already gets the cameras, too.

        Raises as `write_cameras` and `write_rig`.
        """
        with self._lock:
            write_cameras(self.tree, plan)
            self._stop_own()
            self.plan = plan
            if self.state.rig_path(plan.rig).exists():
                write_rig(self.tree, plan)

    def choose_rig(self, plan: Plan) -> None:
        """Write rig, hand and key.

        Raises:
            PhalanxError: As of `write_rig`; the rig is none that the console was set to show.
        """
        shown = self.state.settings.rigs
        if shown and plan.rig not in shown:
            raise CalibrationError(f"this console was started for rig {shown[0]!r}; use that name")
        with self._lock:
            try:
                write_rig(self.tree, plan)
            except ValueError as error:  # of a hand that nobody has
                raise CalibrationError(str(error)) from error
            self._stop_own()
            self.plan = plan

    def start_cameras(self, view: str) -> None:
        """Start or restart all cameras of this machine; simulated ones look at `view`.

        Raises:
            PhalanxError: There is no rig or no key yet, or a process cannot be started.
        """
        with self._lock:
            self._needs_rig()
            environment, epoch_ns = self.commands.environment(), epoch_of(view)
            self.view = view
            self.stop_cameras()
            for camera in self.plan.cameras:
                if camera.kind != "pi":
                    command = self.commands.camera(camera, view, epoch_ns)
                    self.state.local.start(f"camera {camera.name}", command, environment)

    def show(self, view: str) -> None:
        """Let simulated cameras look at `view`; others, and those that do already, go on."""
        if not self.cameras_running or (self.plan.simulated and view != self.view):
            self.start_cameras(view)

    def stop_cameras(self) -> None:
        """End the cameras of this machine."""
        self.state.local.stop(*self.cameras_running)

    def start_master(self) -> None:
        """Start the master; while lenses or places are unknown it only meets cameras.

        Raises:
            PhalanxError: There is no rig or no key yet; another master runs; a process cannot be started.
        """
        with self._lock:
            self._needs_rig()
            if self.foreign_master:
                raise CalibrationError("a master runs that this console did not start: end it first")
            known = {step.key: step.state for step in self.steps()}
            command = self.commands.meet() if known["lens"] is Done.TO_DO else self.commands.run()
            self.state.local.start(MASTER, command, self.commands.environment())

    def stop_master(self) -> None:
        """End the master of this console."""
        self.state.local.stop(MASTER)

    def start_lens(self, values: Mapping[str, Value]) -> Job:
        """Take pictures of the board with all cameras, then fit lenses and places.

        `values`: fields of `calibrate cameras capture`.

        Raises:
            PhalanxError: A field is none; another calibration runs.
        """
        with self._lock:
            self._refuse_busy()
            work = self._work(LENS)
            capture = self.commands.calibrate("capture", values, work, live=False)
            board = {name: values[name] for name in _OF_BOARD if values.get(name) not in (None, "")}
            source = {"source": str(work / "views")}
            stereo = self.commands.calibrate("stereo", board | source, work, live=False)
            self.show("board")
            self._bring_back = (True, True)
            stages = [
                lambda: Stage("taking pictures of the board", {MASTER: capture}),
                lambda: Stage("fitting lenses and places", {"calibrate": stereo}),
            ]
            return self._begin(LENS, "Lenses and places", stages, work)

    def start(self, wizard: Wizard, values: Mapping[str, Value], *, record: bool = False) -> Job:
        """Begin a calibration with the form's values.

        `record`: first make the recording that it is of, with the cameras of this machine.

        Raises:
            PhalanxError: A field is none; another calibration runs; what it needs is not there.
        """
        with self._lock:
            self._refuse_busy()
            work = self._work(wizard.name)
            stages: list[Callable[[], Stage]] = []
            self._bring_back = (bool(self.cameras_running), self.master is not None)
            if record:
                stages, values = recording_stages(self.commands, wizard, values, work)
                self.stop_cameras()
            live = wizard.live and not any(
                values.get(name) for name in ("source", "recording", "poses", "motion")
            )
            line = self.commands.calibrate(wizard.command, {**values, **wizard.fixed}, work, live=live)
            if wizard.master == "run" and live and self.master is None and not self.foreign_master:
                self.start_master()
            keyed = wizard.master != "none"
            if keyed and not record and self.plan.simulated:
                self.show(wizard.scene)
            name = MASTER if wizard.master == "capture" and (live or not wizard.live) else "calibrate"
            stages.append(lambda: Stage(wizard.title, {name: line}, wizard.keyboard and live))
            return self._begin(wizard.name, wizard.title, stages, work, keyed=keyed)

    def use(self, job: Job) -> tuple[Path, ...]:
        """Write a job's results into the tree; a master that met cameras then tracks.

        Raises as `Job.use` and `start_master`.
        """
        written = job.use()
        if self.meets:
            self.start_master()
        return written

    @property
    def meets(self) -> bool:
        """Whether the console's own master runs and only meets the cameras."""
        return self._master_is(self.commands.meet())

    @property
    def tracks(self) -> bool:
        """Whether a master tracks, the console's own or another."""
        return self._master_is(self.commands.run()) or self.foreign_master

    def _master_is(self, command: list[str]) -> bool:
        master = self.master
        return master is not None and master.command == tuple(command)

    def _begin(
        self, key: str, title: str, stages: list[Callable[[], Stage]], work: Path, *, keyed: bool = True
    ) -> Job:
        environment = self.commands.environment() if keyed else {}
        self.jobs[key] = Job(title, stages, self.state.local, environment, self.tree, work, self._after)
        return self.jobs[key]

    def _after(self) -> None:
        """Restore the cameras and the master that a job borrowed."""
        try:
            with self._lock:
                cameras, master = self._bring_back
                if cameras and not self.cameras_running:
                    self.start_cameras(self.view)
                if master and self.master is None and not self.foreign_master:
                    self.start_master()
        except PhalanxError as error:
            _LOG.warning("after a calibration: %s", error)

    def _stop_own(self) -> None:
        """End cameras and master: they would go on with files of the plan before."""
        self.stop_cameras()
        self.stop_master()

    def _refuse_busy(self) -> None:
        for job in self.jobs.values():
            if job.state is JobState.RUNNING:
                raise CalibrationError(f"{job.title} runs: finish or cancel it first")

    def _needs_rig(self) -> None:
        if not self.plan.cameras or not self.state.rig_path(self.plan.rig).exists():
            raise CalibrationError("choose cameras, markers and hand first (steps 1 and 2)")

    def _work(self, name: str) -> Path:
        date = datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%S-%fZ")
        return (self.tree / WORK / f"{name}-{date}").resolve()


_OF_BOARD = ("board", "square_mm", "marker_mm", "dictionary", "circle_mm")


@functools.cache
def session_of(state: ConsoleState) -> Session:
    """The one session of a console, for all its windows.

    Raises:
        CalibrationError: The plan's file is broken.
    """
    return Session(state)


def _plan(state: ConsoleState) -> Plan:
    """Return the page's saved plan of the console's rig, else that of the rig's file."""
    tree, rigs = state.settings.calibration, state.settings.rigs
    plan = load_plan(tree)
    if plan.cameras and (not rigs or plan.rig in rigs):
        return plan
    return plan_of_rig(tree, rigs[0] if rigs else plan.rig)
