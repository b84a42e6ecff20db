"""Table lists the wizards and the recordings that they need.

All cameras of this machine record at once; the recordings are joined and searched for markers.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from common.errors import CalibrationError
from master.console.setup.commands import Commands, Value, epoch_of
from master.console.setup.files import Plan
from master.console.setup.job import Stage

Master = Literal["none", "capture", "run"]
Prepared = Literal["", "markers", "wrist"]

# Fields that the page fills in by itself, for every command that has them.
FILLED = frozenset({"calibration", "out", "json_file", "picture", "rig", "live", "steps"}) | frozenset(
    {"beacon", "bind", "bus", "key_file"}
)


@dataclass(frozen=True, slots=True)
class Wizard:
    """One calibration as a page leads through it.

    Attributes:
        name: Its name in the addresses of the page.
        purpose: What is better afterwards.
        needs, steps: What must be there before, and what the person does.
        master: Which master runs meanwhile: none is needed, it is the master itself, or one that tracks.
        live: Whether it is done before the running cameras (`--live`) if no recording is given.
        keyboard: Whether it waits for Enter between its steps.
        first: Fields shown at once, in this order; the others are under "More options".
        defaults: What fields begin with, where that is not the command's own default.
        prepared: Whose recording it needs: the marker cameras', that of a wrist device; "" for none.
        scene: What simulated cameras show meanwhile.
        seconds: How long a recording is made.
        of: Last word of the command of `phalanx calibrate`, where it is not `name`.
        fixed: Options of that command that make it this calibration; not in the form.
    """

    name: str
    title: str
    purpose: str
    needs: str
    steps: tuple[str, ...]
    master: Master = "none"
    live: bool = False
    keyboard: bool = False
    first: tuple[str, ...] = ()
    defaults: Mapping[str, Value] = field(default_factory=dict[str, Value])
    prepared: Prepared = ""
    scene: str = "standard"
    seconds: float = 0.0
    of: str = ""
    fixed: Mapping[str, Value] = field(default_factory=dict[str, Value])

    @property
    def command(self) -> str:
        """Last word of its command, a key of `CALIBRATIONS`."""
        return self.of or self.name


_BOARD = ("board", "square_mm")
_SOURCE = ("source", *_BOARD)
_RECORD = ("recording", "detections")
_FIT = ("Choose the folder of the pictures.", "Start, look at the residuals, use the result.")

# fmt: off
_CAMERAS = (
    Wizard(
        "board", "Board to print", "A chessboard or ChArUco board at true scale, with a ruler.",
        "A printer, and something flat and stiff to glue the print on.",
        ("Choose the paper.", "Print at 100 %, not “fit to page”.", "Measure the ruler: it must be 100 mm."),
        first=("kind", "paper"),
    ),
    Wizard(
        "capture", "Pictures of a board",
        "Pictures of the board from all cameras at once, for lenses and places.",
        "All cameras running, and the printed board.",
        (
            "Hold the board still before the cameras until the view counts.",
            "Move it, tilt it, come nearer, and hold it still again; read what is still missing.",
        ),
        master="capture", first=(*_BOARD, "views"), scene="board",
    ),
    Wizard(
        "stereo", "Lenses and places of cameras",
        "Where all cameras of the rig stand, and their lenses, in one fit.",
        "Pictures of a board (the calibration before this one).",
        _FIT,
        first=_SOURCE,
    ),
    Wizard(
        "intrinsics", "Lens of one camera",
        "The lens of a camera by itself, as a wrist device's, without moving the others.",
        "Pictures of a board by that camera.",
        _FIT,
        first=(*_SOURCE, "camera"),
    ),
)
_MARKERS = (
    Wizard(
        "depth", "Depth by known distances",
        "A law from raw disparity to depth, measured with a target at known distances.",
        "A target painted like one marker, a tape measure, all cameras running, nobody else tracking.",
        ("Put the target at the distance shown.", "Press Next.", "Go on to the last distance."),
        master="capture", live=True, keyboard=True, first=("marker", "distances", "target"),
        defaults={"marker": "index"},
    ),
    Wizard(
        "verify", "How right is the rig?",
        "What error of depth to expect at which distance, and what was measured, if there is a recording or a table.",
        "Lenses and places.",
        ("Start: nothing else is needed for what is to be expected.",),
        first=("source", "sigma_px", "speed_m_s"), of="depth", fixed={"verify": True},
    ),
    Wizard(
        "time", "Lateness of cameras", "How much later a camera takes its frames than its stamps say.",
        "Lenses, places, colours; a recording of ten seconds.",
        (
            "Swing an open hand to and fro, twice a second, up and down and sideways, fingers still.",
            "Record ten seconds of it.",
        ),
        first=_RECORD, prepared="markers", seconds=10.0,
    ),
    Wizard(
        "hand", "Measure the hand", "Bone lengths of your own hand, from a guided routine of twenty seconds.",
        "Tracking runs.",
        ("Lay the back of the hand on a table, palm to the cameras.", "Do what each line asks."),
        master="run", live=True, first=("name", "side", "length_mm"), scene="hand-routine",
    ),
)
_WRIST = (
    Wizard(
        "laser-plane", "Laser of the wrist device", "The plane of the laser before the wrist camera.",
        "The wrist camera's lens; a small board; a recording with the strobe on.",
        (
            "Hold the board still so that the laser crosses it, at 15 to 35 cm.",
            "Ten views, near and far, tilted.",
        ),
        first=("source", *_BOARD), defaults={"board": "9x6", "square_mm": 15.0}, prepared="wrist",
        scene="board", seconds=20.0,
    ),
    Wizard(
        "flat-field", "Evenness of the wrist device's LEDs",
        "How bright paper looks in every part of the image.",
        "The wrist camera's lens; a board on matt paper; a recording with the strobe on.",
        ("Show the board everywhere, in the corners too, facing the camera, still.", "Twenty views."),
        first=("source", *_BOARD), defaults={"board": "9x6", "square_mm": 15.0}, prepared="wrist",
        scene="board", seconds=30.0,
    ),
    Wizard(
        "palm", "Palm before the wrist camera", "Where the palm is, by a board that lies on it.",
        "The wrist camera's lens; a small board on palm and straight fingers.",
        ("Lay the board on the palm, print to the camera, columns along the middle finger.", "Record it."),
        first=("source", *_BOARD, "wrist_mm", "depth_mm"),
        defaults={"board": "7x4", "square_mm": 10.0, "wrist_mm": 70.0, "depth_mm": 22.0}, prepared="wrist",
        scene="board", seconds=3.0,
    ),
    Wizard(
        "curl", "Lines of the fingers", "Along which line the laser point of each finger moves.",
        "The laser's plane; a recording of a hand that curls slowly.",
        ("Open the hand flat, close it slowly, open it again, twice.", "Record it."),
        first=_RECORD, prepared="wrist", scene="curl", seconds=12.0,
    ),
    Wizard(
        "subject", "Who wears the device",
        "Palm pose, knuckles, thickness and lengths of fingers of the subject.",
        "The laser's plane, a pose of the palm, a hand file of the user's size.",
        (
            "Open the hand flat; bend the straight fingers at the knuckles towards 90° and back.",
            "Open it flat; close it to a fist; open it again. Three seconds or more each.",
        ),
        first=(*_RECORD, "name"), prepared="wrist", scene="subject", seconds=16.0,
    ),
    Wizard(
        "extrinsics", "How the wrist device sits",
        "Palm, IMU and clocks of the device, by what marker cameras and device both see.",
        "Marker cameras and wrist device calibrated by themselves.",
        (
            "Bend fingers one by one and together, bend the wrist both ways, turn the forearm about all its axes.",
            "Briskly: each to and fro about once a second; ten seconds.",
        ),
        first=_RECORD, prepared="wrist", scene="both-moves", seconds=10.0,
    ),
)
_OBJECTS = (
    Wizard(
        "object", "Beads of an object", "Where the painted beads of an object sit.",
        "Tracking runs with a rig that names the beads under free_markers; their colours.",
        ("Turn the object before the cameras for fifteen seconds, each bead seen by two cameras.",),
        master="run", live=True, first=("name", "markers", "radius_mm"), defaults={"name": "wand"},
        scene="object",
    ),
    Wizard(
        "cube", "Box of tags to print", "A box of tags at true scale, and its object file.",
        "A printer, a box of that size.",
        ("Choose name and sides.", "Print at 100 %, measure the ruler.", "Glue it round the box."),
        first=("name", "side_mm", "edge_mm"), of="board", fixed={"kind": "box"},
    ),
    Wizard(
        "tracker", "Tracking system (Vive)",
        "Where a tracking system lies in the rig, and its device on an object.",
        "Tracking runs; the device is fixed to an object that the cameras see.",
        ("Turn it about all its axes, a quarter turn and back, and carry it to all sides, twenty seconds.",),
        master="run", live=True, first=("name", "seconds"), defaults={"name": "cube-tracker"}, scene="object",
    ),
)
# fmt: on
GROUPS: dict[str, tuple[Wizard, ...]] = {
    "Cameras": _CAMERAS,
    "Markers and hand": _MARKERS,
    "Wrist device": _WRIST,
    "Objects": _OBJECTS,
}
WIZARDS: dict[str, Wizard] = {wizard.name: wizard for group in GROUPS.values() for wizard in group}


def no_recording(plan: Plan, wizard: Wizard) -> str:
    """Why the page cannot make a wizard's recording itself; empty if it can."""
    there = "phalanx-slave record (docs/recording.md); then give the folder here"
    if elsewhere := [camera.name for camera in plan.cameras if camera.kind == "pi"]:
        return f"{', '.join(elsewhere)}: records on its own machine: {there}"
    if wizard.prepared != "markers":
        return f"{wizard.title}: the recording is of a wrist device: {there}"
    return ""


def recording_stages(
    commands: Commands, wizard: Wizard, values: Mapping[str, Value], work: Path
) -> tuple[list[Callable[[], Stage]], dict[str, Value]]:
    """Return the stages that make a wizard's recording; `values` with its folders.

    Raises:
        CalibrationError: A camera is not on this machine, or the wizard needs no recording of these cameras.
    """
    if reason := no_recording(commands.plan, wizard):
        raise CalibrationError(reason)
    cameras = commands.plan.cameras
    raw, whole, found = work / "raw", work / "recording", work / "found"
    slave = [sys.executable, "-m", "slave"]

    def record() -> Stage:
        epoch_ns = epoch_of(wizard.scene)
        lines = {
            f"camera {one.name}": commands.record(one, wizard.scene, epoch_ns, wizard.seconds, raw / one.name)
            for one in cameras
        }
        return Stage(f"recording {wizard.seconds:.0f} s", lines)

    def join() -> Stage:
        folders = [str(raw / camera.name) for camera in cameras]
        line = [*slave, "record", "--join", *folders, "-o", str(whole)]
        return Stage("joining the recordings", {"join": line})

    def detect() -> Stage:
        found.mkdir(parents=True, exist_ok=True)
        lines = {
            f"detect {camera.name}": [
                *(*slave, "run", "--name", camera.name, "--camera", f"replay:{whole}"),
                *("--calibration", str(commands.tree)),
                *("-o", str(found / f"detections_{camera.name}.npz")),
            ]
            for camera in cameras
        }
        return Stage("looking for the markers", lines)

    source = "recording" if "recording" in wizard.first else "source"
    return [record, join, detect], {**values, source: str(whole), "detections": str(found)}
