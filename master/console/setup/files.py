"""Set-up page writes its files, for the camera modes that were chosen.

docs/cameras.md gives the reasons of the modes. Row times are those of the sensors' Linux drivers, line length
over pixel rate, times the rows that are added up to one of the picture. Exposure and gains are where to start
from: a bright room, markers well exposed and little smeared. A file that is replaced is kept under old/ of
the tree. What no calibration file has a place for (which camera is simulated, which is a USB one) stands in
console/setup.json of the same tree.
"""

import os
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta
from msgspec.structs import replace

from common.bus.keys import new_key, rig_key
from common.calibration import CameraCalibration, RigCalibration, load, save
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


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode of one sensor.

    Attributes:
        row_time_us: From one row to the next; 0: all at once, or not known.
        view: How much of the lens's full view is in the picture.
        exposure_us, gain, colour_gains: Where to start from.
        focus_m: Of a lens with a motor.
    """

    title: str
    size_px: tuple[int, int]
    rate_hz: float
    row_time_us: float
    view: str
    exposure_us: float = 5000.0
    gain: float = 2.0
    colour_gains: tuple[float, float] = (1.5, 1.5)
    focus_m: float | None = None

    def file(self, name: str) -> CameraCalibration:
        """A camera file of this mode, without lens and colours."""
        return CameraCalibration(
            version=1,
            name=name,
            width_px=self.size_px[0],
            height_px=self.size_px[1],
            frame_rate_hz=self.rate_hz,
            exposure_us=self.exposure_us,
            analogue_gain=self.gain,
            colour_gains=self.colour_gains,
            row_time_us=self.row_time_us,
            focus_m=self.focus_m,
        )


def _usb_mode(width: int, height: int, rate_hz: float) -> Mode:
    title = f"{width} x {height} at {rate_hz:g} Hz"
    return Mode(title, (width, height), rate_hz, 0.0, "row time not known", colour_gains=(1.0, 1.0))


# fmt: off
MODES: dict[Kind, dict[str, Mode]] = {
    "simulated": {},
    "pi": {
        "ov5647": Mode("Camera Module 1 (OV5647)", (640, 480), 58.0, 33.7, "full view"),
        "imx219": Mode("Camera Module 2 (IMX219)", (820, 616), 40.0, 37.8, "full view"),
        "imx219-fast": Mode("Camera Module 2 (IMX219), fast", (640, 480), 90.0, 18.9, "26° of the centre"),
        "imx708": Mode("Camera Module 3 (IMX708)", (1152, 648), 55.0, 26.7, "full view", focus_m=0.6),
        "imx708-fast": Mode("Camera Module 3 (IMX708), fast", (768, 432), 115.0, 18.4, "two thirds of the width",
                            focus_m=0.6),
        "imx296": Mode("Global Shutter Camera (IMX296)", (728, 544), 60.0, 0.0, "full view, all rows at once"),
    },
    "usb": {
        "vga60": _usb_mode(640, 480, 60.0),
        "vga30": _usb_mode(640, 480, 30.0),
        "hd30": _usb_mode(1280, 720, 30.0),
        "hd60": _usb_mode(1280, 720, 60.0),
    },
}
# fmt: on
SIMULATED = "as-simulated"


def modes_of(kind: Kind) -> dict[str, str]:
    """What can be chosen for a camera of this kind: key -> text."""
    if kind == "simulated":
        return {SIMULATED: "Simulated sensor, as its world has it"}
    return {
        key: f"{mode.title}: {mode.size_px[0]} x {mode.size_px[1]} at {mode.rate_hz:g} Hz, {mode.view}"
        if kind == "pi"
        else f"{mode.title} ({mode.view})"
        for key, mode in MODES[kind].items()
    }


def new_file(kind: Kind, mode: str, name: str, truth: Path) -> CameraCalibration:
    """Return the first file of a camera: the chosen mode, no lens and no colours.

    `mode` is a key of `modes_of(kind)`; a simulated camera is like that of the simulated world in tree
    `truth`.

    Raises:
        CalibrationError: The simulated world has no such camera.
    """
    if kind == "simulated":
        true = load(truth / "cameras" / f"{name}.json", CameraCalibration)
        return replace(true, intrinsics=None, markers=None, provenance={})
    return MODES[kind][mode].file(name)


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
    """Return whether lens and colours hold for both: same size and read-out."""
    keys = ("width_px", "height_px", "row_time_us", "focus_m")
    return all(getattr(one, key) == getattr(other, key) for key in keys)


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
