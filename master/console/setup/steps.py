"""Progress of a set-up, derived from its files alone.

It states which steps are done, which are to do, and which are stale and why.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError, PhalanxError
from master.console.setup.files import KEY_FILE, Plan


class Done(StrEnum):
    """Whether a step is done."""

    DONE = "done"
    TO_DO = "to do"
    STALE = "stale"


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the set-up.

    Attributes:
        key: Its name in code and in the page.
        title: For a person.
        state: Whether it is done.
        why: What the state is derived from, or what is to be done.
    """

    key: str
    title: str
    state: Done
    why: str


def steps_of(tree: Path, plan: Plan, *, keyed: bool = False) -> tuple[Step, ...]:
    """Return the steps whose results are files, in order.

    `keyed`: the console was given a key, so the tree needs none.
    """
    cameras, broken = _cameras(tree, plan)
    rig, rig_error = _rig(tree, plan)
    return (
        Step("cameras", "Choose cameras", *_chosen(plan, cameras, broken)),
        Step("rig", "Markers and hand", *_named(tree, plan, rig, rig_error, keyed=keyed)),
        Step("lens", "Lenses and places", *_measured(plan, cameras, rig)),
        Step("colours", "Colours of the markers", *_coloured(plan, cameras, rig)),
    )


def usable(tree: Path, plan: Plan) -> bool:
    """Return whether the files are sufficient to track a hand."""
    return all(step.state is not Done.TO_DO for step in steps_of(tree, plan))


def _cameras(tree: Path, plan: Plan) -> tuple[dict[str, CameraCalibration], str]:
    found: dict[str, CameraCalibration] = {}
    for camera in plan.cameras:
        path = tree / "cameras" / f"{camera.name}.json"
        if path.exists():
            try:
                found[camera.name] = load(path, CameraCalibration)
            except CalibrationError as error:
                return found, str(error)
    return found, ""


def _rig(tree: Path, plan: Plan) -> tuple[RigCalibration | None, str]:
    path = tree / "rigs" / f"{plan.rig}.json"
    if not path.exists():
        return None, ""
    try:
        return load(path, RigCalibration), ""
    except CalibrationError as error:
        return None, str(error)


def _chosen(plan: Plan, cameras: Mapping[str, CameraCalibration], broken: str) -> tuple[Done, str]:
    if broken:
        return Done.STALE, f"{broken}; write the cameras again"
    missing = [camera.name for camera in plan.cameras if camera.name not in cameras]
    if not plan.cameras or missing:
        return Done.TO_DO, f"no file of {', '.join(missing)}" if missing else "how many cameras, and which?"
    return Done.DONE, ", ".join(
        f"{name} {file.width_px} x {file.height_px}" for name, file in cameras.items()
    )


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
