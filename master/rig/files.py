"""Reader of rigs from JSON.

Reads rigs and what they name of a calibration folder; pipelines are made of what it returns.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import replace as with_fields
from pathlib import Path

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.hand.model import HandModel
from master.estimator.settings import DEFAULT, Settings
from master.rig.merge import refuse_shared_senders, rigs_by_hand
from master.rig.objects import gestures_file, load_gestures, load_objects, refuse_shared_objects
from master.rig.setup import RigSetup


def setups_of(
    rigs: Sequence[RigCalibration],
    cameras: Mapping[str, CameraCalibration],
    hand_named: Callable[[str], HandModel],
    objects: Mapping[str, ObjectProfile] | None = None,
    gestures_of: Callable[[str | None], GestureSettings] = lambda _name: default_gestures(),
) -> tuple[RigSetup, ...]:
    """Return the setup of each hand of these rigs.

    What observes each hand, in the order in which the rigs name the hands.

    A marker rig with `other_hands` watches several: each of its markers is that of the hand that mounts it. Free
    markers and objects stay with the rig's first hand.

    Args:
        rigs: One or more.
        cameras: Camera files by name.
        hand_named: The hand of a name.
        objects: Object files by name; None: objects are left out.
        gestures_of: What a rig's `gestures` stands for, or none.

    Raises:
        CalibrationError: As of `RigSetup.joined`; of a rig of several hands a marker is mounted by none or by two; two
            hands' rigs have the same object.
    """
    refuse_shared_senders(rigs)
    found: dict[str, list[RigSetup]] = {}
    for rig in rigs:
        hands = {name: hand_named(name) for name in (rig.hand, *rig.other_hands)}
        for name, own, chosen in rigs_by_hand(rig, hands):
            setup = RigSetup.of(own, cameras, hands[name], objects)
            rows = dict.fromkeys(rig.cameras, chosen) if rig.other_hands else {}
            setup = with_fields(setup, rows=rows, gestures=gestures_of(rig.gestures))
            found.setdefault(name, []).append(setup)
    joined = tuple(RigSetup.joined(setups) for setups in found.values())
    refuse_shared_objects([(setup.rig.name, setup.objects) for setup in joined])
    names = [setup.hand.profile.name for setup in joined]
    if twice := [name for name in names if names.count(name) > 1]:
        raise CalibrationError(f"hands {', '.join(found)}: two files call their hand {twice[0]!r}")
    return joined


def load_setups(
    calibration: Path, rig_names: Sequence[str], hand_file: Path | None = None
) -> tuple[RigSetup, ...]:
    """Read a setup for each hand from a calib_json tree.

    Reads rigs/<rig>.json of each rig, their cameras, hands, objects and gestures.

    Args:
        calibration: The tree.
        rig_names: One or more.
        hand_file: Profile of the hand, in place of that which the rigs name.

    Raises:
        CalibrationError: A file is missing, broken or contradicts another; as of `setups_of`.
    """
    rigs = [load(calibration / "rigs" / f"{name}.json", RigCalibration) for name in rig_names]
    cameras = {
        name: load(calibration / "cameras" / f"{name}.json", CameraCalibration)
        for rig in rigs
        for name in rig.cameras
    }
    return setups_with_hands(rigs, cameras, calibration, hand_file)


def setups_with_hands(
    rigs: Sequence[RigCalibration],
    cameras: Mapping[str, CameraCalibration],
    calibration: Path | None,
    hand_file: Path | None,
    objects: Mapping[str, ObjectProfile] | None = None,
) -> tuple[RigSetup, ...]:
    """Build setups as `setups_of`, loading hands, objects and gestures.

    Each as `load_hand`, `load_objects` and `load_gestures` find it.

    `hand_file` is the hand of all rigs; `objects` are those of a recording, before those of the tree.

    Raises:
        CalibrationError: As of all these; the rigs are of several hands and `hand_file` is one.
    """
    names = tuple(dict.fromkeys(name for rig in rigs for name in (rig.hand, *rig.other_hands)))
    if hand_file is not None and len(names) > 1:
        raise CalibrationError(f"--hand {hand_file}: is one hand; the rigs are of {', '.join(names)}")
    hands = {name: load_hand(calibration, name, hand_file) for name in names}
    watched = load_objects(calibration, rigs, objects or {})
    return setups_of(rigs, cameras, hands.__getitem__, watched, lambda name: load_gestures(calibration, name))


def load_setup(calibration: Path, rig_name: str, hand_file: Path | None = None) -> RigSetup:
    """Read one rig's setup from a calib_json tree.

    Reads rigs/<rig>.json, its cameras, hand, objects and gestures.

    Raises:
        CalibrationError: A file is missing, broken or contradicts another.
    """
    rig = load(calibration / "rigs" / f"{rig_name}.json", RigCalibration)
    cameras = {
        name: load(calibration / "cameras" / f"{name}.json", CameraCalibration) for name in rig.cameras
    }
    setup = RigSetup.of(
        rig, cameras, load_hand(calibration, rig.hand, hand_file), load_objects(calibration, [rig], {})
    )
    return with_fields(setup, gestures=load_gestures(calibration, rig.gestures))


def load_hand(calibration: Path | None, name: str, hand_file: Path | None) -> HandModel:
    """The hand of a rig: `hand_file` if given, else <calibration>/hands/<name>.json.

    Raises:
        CalibrationError: Neither is there, or the profile is broken.
    """
    if hand_file is None:
        if calibration is None:
            raise CalibrationError(
                f"hand {name!r}: give --hand FILE, or --calibration DIR with hands/{name}.json"
            )
        hand_file = calibration / "hands" / f"{name}.json"
        if not hand_file.exists():
            raise CalibrationError(f"{hand_file}: no such hand profile: give --hand FILE")
    profile = load(hand_file, HandProfile)
    try:
        return HandModel.of(profile)
    except CalibrationError as error:
        raise CalibrationError(f"{hand_file}: {error}") from error


@dataclass(frozen=True, slots=True)
class RigFiles:
    """Where setups were read.

    The arguments of `load_setups`, and parameters of the estimator that go with them.
    """

    calibration: Path
    rigs: tuple[str, ...]
    hand: Path | None = None
    settings: Settings = DEFAULT

    def load(self) -> tuple[RigSetup, ...]:
        """Read the files as they are now.

        Raises:
            CalibrationError: As `load_setups`.
        """
        setups = load_setups(self.calibration, self.rigs, self.hand)
        return tuple(with_fields(setup, settings=self.settings) for setup in setups)

    def paths(self, setups: Sequence[RigSetup]) -> tuple[Path, ...]:
        """All files that `setups` were read from."""
        rigs = [self.calibration / "rigs" / f"{name}.json" for name in self.rigs]
        cameras = [
            self.calibration / "cameras" / f"{name}.json" for setup in setups for name in setup.camera_names
        ]
        hands = [self.hand or self.calibration / "hands" / f"{setup.rig.hand}.json" for setup in setups]
        objects = [
            self.calibration / "objects" / f"{one.name}.json" for setup in setups for one in setup.objects
        ]
        gestures = [
            gestures_file(self.calibration, rig.gestures)
            for setup in setups
            for rig in (setup.rig, setup.wrist_rig)
            if rig is not None
        ]
        return tuple(dict.fromkeys([*rigs, *cameras, *hands, *objects, *gestures]))
