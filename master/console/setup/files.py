"""Set-up page writes its files, for the camera modes that were chosen.

The modes are the project's own files of sensors, whose exposure and gains are where to start from: a bright
room, markers well exposed and little smeared. A file that is replaced is kept under old/ of
the tree. What no calibration file has a place for (which camera is simulated, which is a USB one) stands in
console/setup.json of the same tree.
"""

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta
from msgspec.structs import replace

from common.bus.keys import new_key, rig_key
from common.calibration import CameraCalibration, RigCalibration, load, save
from common.calibration.camera import sensor_files
from common.calibration.files import Part, replacing
from common.errors import CalibrationError
from common.hand.fitting import with_three_back_markers
from common.hand.profiles import generated_profile
from common.messages import Name

Kind = Literal["simulated", "usb", "pi"]

KINDS: dict[Kind, str] = {
    "simulated": "Simulated (no hardware)",
    "usb": "USB camera on this computer",
    "pi": "Camera of a Raspberry Pi",
}


DRIVERS: dict[Kind, str] = {"usb": "v4l2", "pi": "picamera2"}
SIMULATED = "as-simulated"


def project_tree() -> Path:
    """Return the project's own calib_json: sensor files and a simulated world.

    Raises:
        CalibrationError: It is neither beside the source nor in the working folder.
    """
    here = Path.cwd()
    for tree in (Path(__file__).resolve().parents[3] / "calib_json", Path("calib_json")):
        if (tree / "rigs" / "desk.json").exists():
            return tree.relative_to(here) if tree.is_relative_to(here) else tree
    raise CalibrationError(
        "no simulated world and no files of sensors: the project's own calib_json is neither beside the source nor in"
        " the working folder; start the console in the project's folder"
    )


def modes_of(kind: Kind) -> dict[str, str]:
    """What can be chosen for a camera of this kind: key -> text.

    Raises:
        CalibrationError: The files of sensors are not there, or one is broken.
    """
    if kind == "simulated":
        return {SIMULATED: "Simulated sensor, as its world has it"}
    files = [(file.sensor, name, file) for name, file in sensor_files(project_tree()).items() if file.sensor]
    seen = [one for one in files if one[0].driver == DRIVERS[kind] and one[0].colours]
    return {
        name: f"{sensor.title} ({sensor.model}): {file.width_px} x {file.height_px} at {file.frame_rate_hz:g} Hz,"
        f" sees {sensor.view_deg[0]:.0f}° x {sensor.view_deg[1]:.0f}°"
        for sensor, name, file in sorted(seen, key=lambda one: one[0].title)
    }


def new_file(kind: Kind, mode: str, name: str, truth: Path) -> CameraCalibration:
    """Return the first file of a camera: the chosen mode, no lens and no colours.

    `mode` is a key of `modes_of(kind)`; a simulated camera is like that of the simulated world in tree
    `truth`.

    Raises:
        CalibrationError: The simulated world has no such camera, or the sensor has no file.
    """
    if kind == "simulated":
        true = load(truth / "cameras" / f"{name}.json", CameraCalibration)
        return replace(true, intrinsics=None, markers=None, provenance={})
    return replace(load(project_tree() / "cameras" / f"{mode}.json", CameraCalibration), name=name)


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


class CameraPlan(Part, frozen=True):
    """One camera as entered on the page.

    `device`: of a USB camera, or the host of a Pi. `options`: of its slave, such as `--control gain=32`.
    """

    name: Name
    kind: Kind
    mode: str
    device: str = ""
    options: str = ""


class Plan(Part, frozen=True):
    """Contents of console/setup.json; `truth`: tree of the simulated world."""

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
        if len(self.cameras) > 2:
            return WORLDS[4]
        return "desk-back3" if self.marker_set == "eight" else WORLDS[2]


def load_plan(tree: Path) -> Plan:
    """Load the saved plan of the page; a new one where nothing was entered.

    Raises:
        CalibrationError: The file is broken.
    """
    path = tree / PLAN
    return load(path, Plan) if path.exists() else Plan()


def plan_of_rig(tree: Path, name: str) -> Plan:
    """Derive the plan from a rig's files; somebody else starts its cameras.

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


def write_cameras(tree: Path, plan: Plan) -> list[Path]:
    """Write plan and camera files; a file of the same mode keeps lens and colours.

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
        replace_file(tree, path, new)
        written.append(path)
    replace_file(tree, tree / PLAN, plan, keep=False)
    return written


def same_mode(one: CameraCalibration, other: CameraCalibration) -> bool:
    """Return whether lens and colours hold for both: same size, read-out and view."""
    keys = ("width_px", "height_px", "row_time_us", "focus_m")
    views = [file.sensor and (file.sensor.model, file.sensor.crop_px) for file in (one, other)]
    return views[0] == views[1] and all(getattr(one, key) == getattr(other, key) for key in keys)


def write_rig(tree: Path, plan: Plan) -> list[Path]:
    """Write the plan, its rig, hand and key; places of the same cameras stay.

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
        rig = replace(there, hand=plan.hand, markers=markers)
    replace_file(tree, hand_path, hand)
    replace_file(tree, path, rig)
    replace_file(tree, tree / PLAN, plan, keep=False)
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


def keep_old(tree: Path, path: Path) -> None:
    """Copy a file that is about to be replaced, if it is there, into old/DATE/.

    Raises:
        CalibrationError: It cannot be copied.
    """
    if not path.exists():
        return
    kept = tree / "old" / datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%SZ") / path.relative_to(tree)
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(path.read_bytes())
    except OSError as error:
        raise CalibrationError(f"{kept}: cannot keep the old file: {error.strerror}") from error


def replace_file(tree: Path, path: Path, content: bytes | Part, *, keep: bool = True) -> None:
    """Put a file into the tree, whole or not at all; `keep`: the old one is kept.

    Raises:
        CalibrationError: It cannot be written.
    """
    if keep:
        keep_old(tree, path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, Part):
            save(path, content)
            return
        with replacing(path) as file:
            file.write(content)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write: {error.strerror}") from error
