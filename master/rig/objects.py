"""Objects and gestures of a rig.

Their files, and what must fit between them and the rig.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from common.calibration import RigCalibration, load
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError

DEFAULT_GESTURES = "default"


def objects_of(rig: RigCalibration, objects: Mapping[str, ObjectProfile]) -> tuple[ObjectProfile, ...]:
    """The objects that a rig names, in its order.

    Raises:
        CalibrationError: One has no file, its file calls it otherwise, a bead of it is not among the rig's
            `free_markers`, or two share a bead, a tag or a tracker.
    """
    found: list[ObjectProfile] = []
    for name in rig.objects:
        if name not in objects:
            raise CalibrationError(f"rig {rig.name!r}: objects: no object file for {name!r}")
        one = objects[name]
        if one.name != name:
            raise CalibrationError(
                f"rig {rig.name!r}: objects: the file of {name!r} calls it {one.name!r}: name"
            )
        for bead in one.markers:
            if bead not in rig.free_markers:
                raise CalibrationError(
                    f"rig {rig.name!r}: free_markers: {bead!r} is missing, a marker of object {name!r}"
                )
        found.append(one)
    _refuse_shared_features(rig.name, found)
    return tuple(found)


def _refuse_shared_features(rig: str, objects: Sequence[ObjectProfile]) -> None:
    """Refuse objects that could be taken for each other."""
    owner: dict[str, str] = {}
    for one in objects:
        tags = (
            () if one.tags is None else tuple(f"tag {tag.id} of {one.tags.family}" for tag in one.tags.tags)
        )
        tracker = () if one.tracker is None else (f"tracker {one.tracker!r}",)
        for feature in (*(f"marker {bead!r}" for bead in one.markers), *tags, *tracker):
            if feature in owner:
                raise CalibrationError(
                    f"rig {rig!r}: objects {owner[feature]!r} and {one.name!r} both have {feature}"
                )
            owner[feature] = one.name


def refuse_shared_objects(watched: Sequence[tuple[str, Sequence[ObjectProfile]]]) -> None:
    """Refuse an object or a tracker that the rigs of two hands share.

    Its poses would come twice.

    Args:
        watched: Of each hand the name of its rig, and its objects.

    Raises:
        CalibrationError: With both rigs and the object.
    """
    owner: dict[str, str] = {}
    for rig, objects in watched:
        for one in objects:
            for what in (
                f"object {one.name!r}",
                *(() if one.tracker is None else (f"tracker {one.tracker!r}",)),
            ):
                if what in owner:
                    raise CalibrationError(
                        f"rigs {owner[what]!r} and {rig!r} both have {what}: objects: let one of them have it"
                    )
                owner[what] = rig


def load_objects(
    calibration: Path | None, rigs: Sequence[RigCalibration], known: Mapping[str, ObjectProfile]
) -> dict[str, ObjectProfile]:
    """Load the objects that these rigs name.

    From `known`, else <calibration>/objects/<name>.json.

    Raises:
        CalibrationError: One is in neither, or its file is broken.
    """
    found: dict[str, ObjectProfile] = {}
    for rig in rigs:
        for name in rig.objects:
            if name in known:
                found[name] = known[name]
            elif calibration is None:
                raise CalibrationError(
                    f"rig {rig.name!r}: object {name!r}: give --calibration DIR with objects/{name}.json"
                )
            else:
                found[name] = load(calibration / "objects" / f"{name}.json", ObjectProfile)
    return found


def load_gestures(calibration: Path | None, name: str | None) -> GestureSettings:
    """Load <calibration>/gestures/<name>.json.

    For a rig that names none, default.json, and where that does not exist either, the shipped settings.

    Raises:
        CalibrationError: A file that is named is missing, or one is broken.
    """
    if calibration is None:
        if name is not None:
            raise CalibrationError(f"gestures {name!r}: give --calibration DIR with gestures/{name}.json")
        return default_gestures()
    path = gestures_file(calibration, name)
    return load(path, GestureSettings) if name is not None or path.exists() else default_gestures()


def gestures_file(calibration: Path, name: str | None) -> Path:
    """Where the gestures of a rig stand, that names them or does not."""
    return calibration / "gestures" / f"{name or DEFAULT_GESTURES}.json"
