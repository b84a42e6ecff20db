"""Files that the set-up page writes: its own plan, cameras, rig, hand and key.

An old file is kept beside the tree's.

What was entered on the page and no calibration file has a place for (which camera is simulated, which is a USB one)
stands in console/setup.json of the same tree, so that the set-up goes on where it was left.
"""

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from common.bus.keys import new_key, rig_key
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load, save
from common.calibration.parts import Part
from common.calibration.replacing import replacing
from common.errors import CalibrationError
from common.hand.back_markers import with_three_back_markers
from common.hand.profiles import generated_profile
from common.messages import Name
from master.console.setup.modes import Kind, new_file

OLD = "old"
KEY_FILE = "rig.key"
PLAN = Path("console") / "setup.json"
MARKER_SETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "six": ("Five fingertips and one on the back", ("thumb", "index", "middle", "ring", "little", "back")),
    "eight": (
        "Five fingertips and three on the back (palm known when fingers hide)",
        ("thumb", "index", "middle", "ring", "little", "back", "back2", "back3"),
    ),
}
# Simulated worlds, by how many cameras they have: rigs of the project's own calibration tree.
WORLDS = {2: "desk", 4: "desk4"}
WORLDS_EIGHT = {2: "desk-back3"}


class CameraPlan(Part, frozen=True):
    """One camera as entered on the page: what it is, where, and more options.

    Where is the device of a USB camera, or the host of a Pi; the options are those of its slave, such as `--control
    gain=32`.
    """

    name: Name
    kind: Kind
    mode: str
    device: str = ""
    options: str = ""


class Plan(Part, frozen=True):
    """Contents of console/setup.json: what was entered on the page.

    `truth`: tree of the simulated world.
    """

    version: Literal[1] = 1
    rig: Name = "desk"
    marker_set: str = "six"
    side: Literal["left", "right"] = "right"
    length_mm: Annotated[float, Meta(ge=100.0, le=250.0)] = 190.0
    cameras: tuple[CameraPlan, ...] = ()
    truth: str = ""

    @property
    def simulated(self) -> bool:
        """Whether any camera is simulated."""
        return any(camera.kind == "simulated" for camera in self.cameras)

    @property
    def hand(self) -> str:
        """Name of the hand's file."""
        return f"{self.rig}-{self.side}"

    @property
    def world(self) -> str:
        """The rig of the simulated world."""
        several = len(self.cameras) > 2
        if self.marker_set == "eight" and not several:
            return WORLDS_EIGHT[2]
        return WORLDS[4 if several else 2]


def load_plan(tree: Path) -> Plan:
    """Load the saved plan of the page.

    It is a new plan where nothing was entered.

    Raises:
        CalibrationError: The file is broken.
    """
    path = tree / PLAN
    return load(path, Plan) if path.exists() else Plan()


def plan_of_rig(tree: Path, name: str) -> Plan:
    """Derive the plan from a rig's files where nothing was entered on the page.

    Its cameras count as ones that somebody else starts.

    Raises:
        CalibrationError: The rig's file is broken.
    """
    path = tree / "rigs" / f"{name}.json"
    if not path.exists():
        return Plan(rig=name)
    rig = load(path, RigCalibration)
    if rig.kind != "markers":
        return Plan(rig=name)
    cameras = tuple(CameraPlan(name=camera, kind="pi", mode="") for camera in rig.cameras)
    return Plan(rig=name, cameras=cameras, marker_set="eight" if "back2" in rig.markers else "six")


def save_plan(tree: Path, plan: Plan) -> None:
    """Keep the plan.

    Raises:
        CalibrationError: The folder cannot be written.
    """
    _save(tree / PLAN, plan)


def write_cameras(tree: Path, plan: Plan) -> list[Path]:
    """Write the camera files of the plan, and save the plan.

    A file of the same mode stays as it is, with lens and colours.

    Raises:
        CalibrationError: A name stands twice, a simulated world has no such camera, a file cannot be written.
    """
    names = [camera.name for camera in plan.cameras]
    if len(names) < 2:
        raise CalibrationError("cameras: two or more are needed, since one alone measures no distance")
    if twice := [name for name in names if names.count(name) > 1]:
        raise CalibrationError(f"cameras: {twice[0]!r} stands twice; give each a name of its own")
    written: list[Path] = []
    for camera in plan.cameras:
        path = tree / "cameras" / f"{camera.name}.json"
        new = new_file(camera.kind, camera.mode, camera.name, Path(plan.truth))
        if path.exists() and same_mode(load(path, CameraCalibration), new):
            continue
        keep_old(tree, path)
        _save(path, new)
        written.append(path)
    save_plan(tree, plan)
    return written


def same_mode(one: CameraCalibration, other: CameraCalibration) -> bool:
    """Return whether lens and colours of one mode hold for the other.

    They do where size and read-out are the same.
    """
    return (one.width_px, one.height_px, one.row_time_us, one.focus_m) == (
        other.width_px,
        other.height_px,
        other.row_time_us,
        other.focus_m,
    )


def write_rig(tree: Path, plan: Plan) -> list[Path]:
    """Write rig, hand and key of the plan, and save the plan.

    Measured camera places stay while the cameras are the same.

    Raises:
        CalibrationError: No cameras yet, no hand is of that length, or a file cannot be written.
    """
    if not plan.cameras:
        raise CalibrationError("choose the cameras first (step 1)")
    names, markers = tuple(camera.name for camera in plan.cameras), MARKER_SETS[plan.marker_set][1]
    hand = generated_profile(plan.hand, plan.side, 1e-3 * plan.length_mm)
    if "back2" in markers:
        hand = with_three_back_markers(hand, plan.hand)
    rig = RigCalibration(
        version=1, name=plan.rig, kind="markers", cameras=names, hand=plan.hand, markers=markers
    )
    path, hand_path = tree / "rigs" / f"{plan.rig}.json", tree / "hands" / f"{plan.hand}.json"
    if path.exists() and (there := load(path, RigCalibration)).cameras == names and there.kind == "markers":
        rig = msgspec.structs.replace(there, hand=plan.hand, markers=markers)
    keep_old(tree, path)
    keep_old(tree, hand_path)
    _save(hand_path, hand)
    _save(path, rig)
    save_plan(tree, plan)
    return [hand_path, path, write_key(tree)]


def write_key(tree: Path) -> Path:
    """The rig's key file, which only its owner can read; made if there is none.

    Raises:
        CalibrationError: It cannot be written.
    """
    path = tree / KEY_FILE
    try:
        tree.mkdir(parents=True, exist_ok=True)
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:  # noqa: PTH123
            file.write(new_key() + "\n")
    except FileExistsError:
        return path
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write the key: {error.strerror}") from error
    return path


def key_of(tree: Path, given: bytes | None) -> str:
    """The key as processes are given it: the console's own, else that of the tree.

    Raises:
        PhalanxError: The file is missing, broken, or others can read it.
    """
    return (given if given is not None else rig_key({}, tree / KEY_FILE)).hex()


def keep_old(tree: Path, path: Path) -> Path | None:
    """Copy a file that is about to be replaced into old/DATE/ of the tree.

    Return None if there is no such file.

    Raises:
        CalibrationError: It cannot be copied.
    """
    if not path.exists():
        return None
    folder = tree / OLD / datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    kept = folder / path.relative_to(tree)
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(path.read_bytes())
    except OSError as error:
        raise CalibrationError(f"{kept}: cannot keep the old file: {error.strerror}") from error
    return kept


def replace_file(tree: Path, path: Path, content: bytes) -> None:
    """Put a file into the tree, whole or not at all; the old one is kept.

    Raises:
        CalibrationError: It cannot be written.
    """
    keep_old(tree, path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(content)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write: {error.strerror}") from error


def _save(path: Path, value: Plan | CameraCalibration | RigCalibration | HandProfile) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"{path.parent}: cannot make the folder: {error.strerror}") from error
    save(path, value)
