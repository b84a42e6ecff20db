"""Sensors that a demo simulates, and which rigs see a scene best.

The sensors are the cameras, IMUs and trackers of its rigs.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

SensorKind = Literal["camera", "imu", "tracker"]

TOGETHER = (
    "grasp",
    "both-poses",
    "both-curl",
    "both-travel",
    "both-moves",
    "gestures",
)  # seen by both kinds of rig alike
# Scene -> its rigs, where it is no other than `desk`.
_BEST = {
    **dict.fromkeys(TOGETHER, ("desk-back3", "wrist-back3")),
    "object": ("desk-wand",),
    "gestures": ("desk4",),  # fingers that bend towards one pair are seen by the other
}


class DemoError(Exception):
    """Error for a demo that cannot run.

    The text states why and what to do.
    """


@dataclass(frozen=True, slots=True)
class Sensor:
    """A camera, an IMU or a tracker of a rig, and the scene that it senses."""

    name: str
    rig: str
    scene: str
    kind: SensorKind = "camera"


def best_rigs(scene: str) -> tuple[str, ...]:
    """The rigs that a scene is played before, if the user chooses none."""
    return _BEST.get(scene.partition("@")[0], ("desk",))


def sensors_of(calibration: Path, rigs: tuple[str, ...], scene: str) -> list[Sensor]:
    """Return the simulated sensors of all rigs.

    The cameras of all rigs, then each IMU whose mounting and world are known, then each tracker on an object.

    Raises:
        DemoError: A rig cannot be read, two have a sensor of the same name, or rigs of one hand would each see another.
    """
    read = {name: _rig(calibration, name) for name in rigs}
    if len(read) < len(rigs):
        raise DemoError(f"--rig {' --rig '.join(rigs)}: a rig stands twice")
    moves, _, light = scene.partition("@")
    hands = [rig.hand for rig in read.values()]
    if len(set(hands)) < len(hands) and moves not in TOGETHER:
        raise DemoError(
            f"--scene {scene}: rigs {', '.join(read)} see one hand together only in {', '.join(TOGETHER)}"
        )
    if moves == "object" and not any(rig.objects for rig in read.values()):
        raise DemoError(
            f"--scene object: rig {', '.join(read)} tracks no object; --rig desk-wand or desk-cube does"
        )
    has_wrist_rig = any(rig.kind == "wrist" for rig in read.values())
    found: dict[SensorKind, list[Sensor]] = {"camera": [], "imu": [], "tracker": []}
    for name, rig in read.items():
        # The light behind the @ is that of a wrist device; cameras that watch markers have their own.
        own = moves if light and has_wrist_rig and rig.kind == "markers" else scene
        found["camera"] += [Sensor(one, name, own) for one in rig.cameras]
        found["imu"] += [Sensor(one, name, own, "imu") for one in rig.imus]
        found["tracker"] += [Sensor(one, name, own, "tracker") for one in rig.trackers]
    sensors = [*found["camera"], *found["imu"], *found["tracker"]]
    names = [sensor.name for sensor in sensors]
    if twice := [name for name in names if names.count(name) > 1]:
        raise DemoError(
            f"rigs {', '.join(read)}: {twice[0]!r} stands twice; every sensor has a name of its own"
        )
    return sensors


def rig_options(rigs: tuple[str, ...]) -> list[str]:
    """`--rig` for each."""
    return [word for rig in rigs for word in ("--rig", rig)]


@dataclass(frozen=True, slots=True)
class _Rig:
    """A rig file, as far as it matters here."""

    kind: str
    hand: str
    cameras: list[str]
    imus: list[str]
    objects: list[str]
    trackers: list[str]


def _rig(calibration: Path, name: str) -> _Rig:
    path = calibration / "rigs" / f"{name}.json"
    try:
        rig = json.loads(path.read_text())
        imu = cast(dict[str, object], rig.get("imu") or {})
        placed = imu.get("q_palm_imu") is not None and imu.get("q_rig_world") is not None
        imus = [str(imu.get("name", "imu"))] if placed else []
        objects = cast(list[str], rig.get("objects") or [])
        files = [calibration / "objects" / f"{one}.json" for one in objects]
        trackers = [
            str(tracker) for file in files if (tracker := json.loads(file.read_text()).get("tracker"))
        ]
        cameras = cast(list[str], rig["cameras"])
        return _Rig(str(rig.get("kind")), str(rig.get("hand")), cameras, imus, objects, trackers)
    except (AttributeError, OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        raise DemoError(
            f"{path}: cannot read the rig ({error}); give --calibration DIR and --rig NAME"
        ) from error
