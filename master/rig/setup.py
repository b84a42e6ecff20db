"""Setup of one hand is read from the rig's files.

A rig and all that its files refer to, checked, and the rigs of one hand joined. Pipelines are made of it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as with_fields
from pathlib import Path
from typing import Literal

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import (
    CameraCalibration,
    FilterCalibration,
    HandProfile,
    ImuCalibration,
    RigCalibration,
    Volume,
    load,
)
from common.calibration.camera import Hsv
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.calibration.object_profile import ObjectProfile
from common.calibration.rig import FingerLine, rigs_by_hand
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.hand.model import FINGERS, HandModel
from common.hand.wrist import WristDevice, forearm_palm
from common.messages import Detections, MarkerDetections
from master.estimator.settings import DEFAULT, Settings
from master.rig.merge import (
    gestures_file,
    gestures_named,
    load_gestures,
    load_objects,
    merged_rig,
    objects_of,
    refuse_shared_objects,
    refuse_shared_senders,
)

Paints = tuple[tuple[Hsv, Hsv] | None, ...]  # lowest and highest colour of each marker


@dataclass(frozen=True, slots=True, eq=False)
class WristSetup(WristDevice):
    """A wrist rig as arrays, in the frame of its camera, which is the rig frame.

    Attributes:
        laser_m: (3,) where the laser light comes from, in its plane.
        lines: Finger -> the measured line its laser point moves along; of none, the simulated one counts.
        cubic: Flexion by the cubic printed in the paper and not by the table of this hand.
        solver_mode: What fingers are solved from: "fk", "ik" or "auto".
        filter: Of the laser points, where frames follow each other.
        volume: What the rig states, or None.
        frame_s: From frame to frame of its camera.
        late_ns: How much later frames are taken than their stamps state [ns].
        imu: The IMU on the forearm, where it is known how that is mounted; or None.
    """

    laser_m: Float
    lines: dict[str, FingerLine]
    cubic: bool
    solver_mode: Literal["fk", "ik", "auto"]
    filter: FilterCalibration
    volume: Volume | None = None
    late_ns: int = 0
    frame_s: float = 1.0 / 90.0
    imu: ImuCalibration | None = None

    @classmethod
    def of(cls, rig: RigCalibration, camera: CameraCalibration, model: HandModel) -> "WristSetup":
        """Build and check.

        Where the rig does not state where its laser is, it is put at the foot of the camera on its plane: the
        laser of such a device sits beside the lens.

        Raises:
            CalibrationError: As of `WristDevice.joined`.
        """
        device = WristDevice.joined(rig, camera, model)
        normal, offset_m = device.normal, device.offset_m
        origin = rig.laser.origin if rig.laser is not None else None
        laser = offset_m * normal if origin is None else np.array(origin)
        return cls(
            optics=device.optics,
            model=device.model,
            T_camera_palm=device.T_camera_palm,
            normal=normal,
            offset_m=offset_m,
            laser_m=laser + (offset_m - laser @ normal) * normal,
            lines={name: rig.finger_lines[name] for name in FINGERS if name in rig.finger_lines},
            cubic=rig.forward == "cubic",
            solver_mode=rig.solver_mode,
            filter=rig.filter,
            volume=rig.volume,
            frame_s=1.0 / camera.frame_rate_hz,
            late_ns=round(1e3 * rig.stamp_offset_us.get(camera.name, 0.0)),
            imu=rig.imu if rig.imu is not None and rig.imu.q_palm_imu is not None else None,
        )

    def flexed(self, wrist_angles_rad: Float) -> "WristSetup":
        """Return the setup with the wrist flexed by (2,) [rad] (`common.hand.wrist`)."""
        T = self.T_camera_palm.copy()
        T[:3, :3] = T[:3, :3] @ forearm_palm(wrist_angles_rad)
        return with_fields(self, T_camera_palm=T)


@dataclass(frozen=True, slots=True, eq=False)
class RigSetup:
    """All that observes one hand, checked: a marker rig, a wrist device, or both.

    Attributes:
        rig: The rig file; of several marker rigs what they are together; with markers and a wrist device the
            former.
        cameras: Camera files by name, in the order of the rigs.
        models: Those of `rig` as camera models, placed in its frame, which is that of the poses.
        hand: The hand model.
        wrist: Laser plane and palm of a wrist device; None: there is none.
        wrist_rig: The rig file of that device.
        rows: Camera -> which rows of its messages are `markers`, where it watches another hand as well.
        paints: Camera -> the colour range of each of `markers`, likewise; None: it has none.
        objects: What else its marker cameras watch, in the order of the rig; of a rig of several hands with
            the first.
        gestures: What counts as a gesture of this hand.
        settings: Numbers of the estimator.
    """

    rig: RigCalibration
    cameras: dict[str, CameraCalibration]
    models: dict[str, CameraModel]
    hand: HandModel
    wrist: WristSetup | None = None
    wrist_rig: RigCalibration | None = None
    rows: dict[str, tuple[int, ...]] = field(default_factory=dict[str, tuple[int, ...]])
    paints: dict[str, Paints] = field(default_factory=dict[str, Paints])
    objects: tuple[ObjectProfile, ...] = ()
    gestures: GestureSettings = field(default_factory=default_gestures)
    settings: Settings = DEFAULT

    @property
    def has_markers(self) -> bool:
        """Whether cameras watch painted markers."""
        return self.rig.kind == "markers"

    @property
    def markers(self) -> tuple[str, ...]:
        """Names of the markers; a wrist device has none."""
        return self.rig.markers if self.has_markers else ()

    @property
    def camera_names(self) -> tuple[str, ...]:
        """All cameras, those of markers first."""
        return tuple(self.cameras)

    @property
    def wrist_cameras(self) -> tuple[str, ...]:
        """Return the cameras that send strobe cycles and no markers."""
        return () if self.wrist_rig is None else self.wrist_rig.cameras

    @property
    def hand_markers(self) -> tuple[str, ...]:
        """The rig's markers that sit on the hand, in the rig's order."""
        return tuple(name for name in self.markers if name not in self.rig.free_markers)

    @property
    def imus(self) -> tuple[str, ...]:
        """The IMU on the palm or on the forearm, if there is one."""
        rigs = (self.rig,) if self.wrist_rig in (None, self.rig) else (self.rig, self.wrist_rig)
        return tuple(rig.imu.name for rig in rigs if rig.imu is not None)

    @property
    def trackers(self) -> tuple[str, ...]:
        """The devices that track themselves and sit on its objects."""
        return tuple(one.tracker for one in self.objects if one.tracker is not None)

    @property
    def senders(self) -> frozenset[str]:
        """All whose messages are of it."""
        return frozenset((*self.camera_names, *self.imus, *self.trackers))

    def own(self, message: Detections) -> Detections:
        """The message with the markers of this hand alone."""
        rows = self.rows.get(message.camera)
        if rows is None or not isinstance(message, MarkerDetections):
            return message
        chosen = list(rows)
        return replace(
            message,
            uv=message.uv[chosen],
            area=message.area[chosen],
            quality=message.quality[chosen],
            sigma_px=message.sigma_px[chosen],
            alt_uv=message.alt_uv[chosen],
        )

    @classmethod
    def of(
        cls,
        rig: RigCalibration,
        cameras: Mapping[str, CameraCalibration],
        hand: HandModel,
        objects: Mapping[str, ObjectProfile] | None = None,
    ) -> "RigSetup":
        """Join the files of a rig that watches one hand; `objects` None: left out.

        Raises:
            CalibrationError: A camera of the rig is missing or has no intrinsics; of a marker rig: fewer than
                two cameras, several hands, a marker the hand does not mount and that is not free, or as of
                `objects_of`; of a wrist device: no laser plane or no palm pose.
        """
        if rig.kind == "markers" and len(rig.cameras) < 2:
            raise CalibrationError(f"rig {rig.name!r}: cameras: two or more are needed")
        if rig.other_hands:
            raise CalibrationError(
                f"rig {rig.name!r}: other_hands: it watches {1 + len(rig.other_hands)} hands, this needs a rig of one"
            )
        missing = [name for name in rig.cameras if name not in cameras]
        if missing:
            raise CalibrationError(f"rig {rig.name!r}: no camera file for {missing[0]!r}")
        ordered = {name: cameras[name] for name in rig.cameras}
        models = {name: CameraModel.of(camera, rig.camera_pose(name)) for name, camera in ordered.items()}
        if rig.kind == "wrist":
            wrist = WristSetup.of(rig, ordered[rig.cameras[0]], hand)
            return cls(rig, ordered, models, hand, wrist, rig)
        _check_mounts(rig, hand)
        watched = () if objects is None else objects_of(rig, objects)
        return cls(rig, ordered, models, hand, objects=watched)

    @classmethod
    def joined(cls, setups: Sequence["RigSetup"]) -> "RigSetup":
        """Join one or more setups that observe one hand.

        Its marker rigs become one of N cameras in the frame that they share (`T_world_rig`), and its wrist
        device stands beside them.

        Raises:
            CalibrationError: They are of different hands, two are wrist devices, two have a camera or IMU of
                the same name or two IMUs, name two files of gestures, or the marker rigs cannot be merged
                (`merged_rig`).
        """
        marked = [setup for setup in setups if setup.has_markers]
        wrist_setups = [setup for setup in setups if not setup.has_markers]
        rigs = [setup.rig for setup in setups]
        _refuse_two(setups)
        refuse_shared_senders(rigs)
        gestures_named(rigs)
        if not marked:
            return wrist_setups[0]
        cameras = {name: file for setup in marked for name, file in setup.cameras.items()}
        objects = {one.name: one for setup in marked for one in setup.objects}
        merged = merged_rig([setup.rig for setup in marked])
        out = cls.of(merged, cameras, setups[0].hand, objects or None)
        named = (setup.gestures for setup in setups if setup.rig.gestures is not None)
        rows = {name: which for setup in marked for name, which in setup.rows.items()}
        paints = {name: which for setup in marked for name, which in setup.paints.items()}
        out = with_fields(out, gestures=next(named, setups[0].gestures), rows=rows, paints=paints)
        for device in wrist_setups:  # one, or none
            cameras |= device.cameras
            out = with_fields(out, cameras=cameras, wrist=device.wrist, wrist_rig=device.rig)
        return out


def _check_mounts(rig: RigCalibration, hand: HandModel) -> None:
    for name in rig.markers:
        if name not in rig.free_markers:
            try:
                hand.mount(name)
            except CalibrationError as error:
                raise CalibrationError(
                    f"rig {rig.name!r}: {error}; what sits on no hand, as a bead of an object does, stands under "
                    "'free_markers' as well"
                ) from error


def _refuse_two(setups: Sequence[RigSetup]) -> None:
    """Refuse rigs of two hands, with two wrist devices or with two IMUs."""
    first = setups[0]
    for setup in setups:
        if setup.hand.profile != first.hand.profile:
            raise CalibrationError(
                f"rigs {first.rig.name!r} and {setup.rig.name!r} are of different hands,"
                f" {first.hand.profile.name!r} and {setup.hand.profile.name!r}"
            )
    worn = [setup.rig.name for setup in setups if not setup.has_markers]
    if len(worn) > 1:
        raise CalibrationError(
            f"rigs {worn[0]!r} and {worn[1]!r} are both of kind 'wrist' and of hand"
            f" {first.hand.profile.name!r}: a hand wears one wrist device"
        )
    sensed = [setup.rig.name for setup in setups if setup.rig.imu is not None]
    if len(sensed) > 1:
        raise CalibrationError(
            f"rigs {sensed[0]!r} and {sensed[1]!r} both have an IMU: imu: a hand has one, on the palm or on the forearm"
        )


def setups_of(
    rigs: Sequence[RigCalibration],
    cameras: Mapping[str, CameraCalibration],
    hand_named: Callable[[str], HandModel],
    objects: Mapping[str, ObjectProfile] | None = None,
    gestures_of: Callable[[str | None], GestureSettings] = lambda _name: default_gestures(),
) -> tuple[RigSetup, ...]:
    """Return the setup of each hand, in the order in which the rigs name the hands.

    A marker rig with `other_hands` watches several: each of its markers is that of the hand that mounts it.
    Free markers and objects stay with the rig's first hand. `objects` None: they are left out. `gestures_of`:
    what a rig's `gestures`, or none, stands for.

    Raises:
        CalibrationError: As of `RigSetup.joined`; of a rig of several hands a marker is mounted by none or by
            two; two hands' rigs have the same object.
    """
    refuse_shared_senders(rigs)
    found: dict[str, list[RigSetup]] = {}
    for rig in rigs:
        hands = {name: hand_named(name) for name in (rig.hand, *rig.other_hands)}
        for name, own, chosen in rigs_by_hand(rig, {name: hand.profile for name, hand in hands.items()}):
            setup = RigSetup.of(own, cameras, hands[name], objects)
            if rig.other_hands:
                names = [rig.markers[m] for m in chosen]
                paints = {camera: _paints_of(cameras[camera], names) for camera in rig.cameras}
                setup = with_fields(setup, rows=dict.fromkeys(rig.cameras, chosen), paints=paints)
            setup = with_fields(setup, gestures=gestures_of(rig.gestures))
            found.setdefault(name, []).append(setup)
    joined = tuple(RigSetup.joined(setups) for setups in found.values())
    refuse_shared_objects([(setup.rig.name, setup.objects) for setup in joined])
    names = [setup.hand.profile.name for setup in joined]
    if twice := [name for name in names if names.count(name) > 1]:
        raise CalibrationError(f"hands {', '.join(found)}: two files call their hand {twice[0]!r}")
    return joined


def _paints_of(camera: CameraCalibration, markers: Sequence[str]) -> Paints:
    ranges = camera.markers or {}
    return tuple((ranges[m].hsv_low, ranges[m].hsv_high) if m in ranges else None for m in markers)


def load_setups(
    calibration: Path, rig_names: Sequence[str], hand_file: Path | None = None
) -> tuple[RigSetup, ...]:
    """Read a setup for each hand from a calib_json tree.

    Reads rigs/<rig>.json of each rig, their cameras, hands, objects and gestures; `hand_file` is a hand in
    place of that which the rigs name.

    Raises:
        CalibrationError: A file is missing, broken or contradicts another; as of `setups_of`.
    """
    rigs = [load(calibration / "rigs" / f"{name}.json", RigCalibration) for name in rig_names]
    return setups_with_hands(rigs, _load_cameras(calibration, rigs), calibration, hand_file)


def _load_cameras(calibration: Path, rigs: Sequence[RigCalibration]) -> dict[str, CameraCalibration]:
    names = [name for rig in rigs for name in rig.cameras]
    return {name: load(calibration / "cameras" / f"{name}.json", CameraCalibration) for name in names}


def setups_with_hands(
    rigs: Sequence[RigCalibration],
    cameras: Mapping[str, CameraCalibration],
    calibration: Path | None,
    hand_file: Path | None,
    objects: Mapping[str, ObjectProfile] | None = None,
) -> tuple[RigSetup, ...]:
    """Build setups as `setups_of`, loading hands, objects and gestures.

    `hand_file` is the hand of all rigs; `objects` are those of a recording, before those of the tree.

    Raises:
        CalibrationError: As of `load_hand`, `load_objects`, `load_gestures`; the rigs are of several hands
            and `hand_file` is one.
    """
    names = tuple(dict.fromkeys(name for rig in rigs for name in (rig.hand, *rig.other_hands)))
    if hand_file is not None and len(names) > 1:
        raise CalibrationError(f"--hand {hand_file}: is one hand; the rigs are of {', '.join(names)}")
    hands = {name: load_hand(calibration, name, hand_file) for name in names}
    watched = load_objects(calibration, rigs, objects or {})
    return setups_of(rigs, cameras, hands.__getitem__, watched, lambda name: load_gestures(calibration, name))


def load_setup(calibration: Path, rig_name: str, hand_file: Path | None = None) -> RigSetup:
    """Read one rig's setup from a calib_json tree.

    Raises:
        CalibrationError: A file is missing, broken or contradicts another.
    """
    rig = load(calibration / "rigs" / f"{rig_name}.json", RigCalibration)
    cameras, hand = _load_cameras(calibration, [rig]), load_hand(calibration, rig.hand, hand_file)
    setup = RigSetup.of(rig, cameras, hand, load_objects(calibration, [rig], {}))
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
    """Where setups were read: arguments of `load_setups`, numbers of the estimator."""

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
        tree = self.calibration
        paths = [tree / "rigs" / f"{name}.json" for name in self.rigs]
        for setup in setups:
            paths += [tree / "cameras" / f"{name}.json" for name in setup.camera_names]
            paths.append(self.hand or tree / "hands" / f"{setup.rig.hand}.json")
            paths += [tree / "objects" / f"{one.name}.json" for one in setup.objects]
            rigs = (setup.rig, setup.wrist_rig)
            paths += [gestures_file(tree, rig.gestures) for rig in rigs if rig is not None]
        return tuple(dict.fromkeys(paths))
