"""Setup that observes one hand.

A rig and all that its files refer to, checked, and the rigs of one hand joined.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as with_fields

from msgspec.structs import replace

from common.calibration import CameraCalibration, RigCalibration
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.hand.model import HandModel
from common.messages import Detections, MarkerDetections
from master.estimator.settings import DEFAULT, Settings
from master.rig.merge import gestures_named, merged_rig, refuse_shared_senders
from master.rig.objects import objects_of
from master.rig.wrist import WristSetup


@dataclass(frozen=True, slots=True, eq=False)
class RigSetup:
    """Setup that observes one hand, with all files it refers to, checked.

    A marker rig, a wrist device, or both.

    Attributes:
        rig: The rig file; of several marker rigs what they are together; with markers and a wrist device the former.
        cameras: Camera files by name, in the order of the rigs.
        models: Those of `rig` as camera models, placed in its frame, which is that of the poses.
        hand: The hand model.
        wrist: Laser plane and palm of a wrist device; None: there is none.
        wrist_rig: The rig file of that device.
        rows: Camera -> which rows of its messages are `markers`, where it watches another hand as well.
        objects: What else its marker cameras watch, in the order of the rig; of a rig of several hands with the first.
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
        """Join the files of a rig that watches one hand.

        Args:
            rig: The rig.
            cameras: Camera files by name; more than its own do not matter.
            hand: The hand.
            objects: Object files by name; None: its objects are left out, only the hand is wanted.

        Raises:
            CalibrationError: A camera of the rig is missing or has no intrinsics; of a marker rig: fewer than two
                cameras, several hands, a marker the hand does not mount and that is not free, or as of
                `rig_objects.objects_of`; of a wrist device: no laser plane or no palm pose.
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
        """Join all setups that observe one hand.

        Its marker rigs become one of N cameras in the frame that they share (`T_world_rig`), and its wrist device
        stands beside them.

        Args:
            setups: One or more, of one hand.

        Raises:
            CalibrationError: They are of different hands, two are wrist devices, two have a camera or IMU of the same
                name or two IMUs, name two files of gestures, or the marker rigs cannot be merged (`merged_rig`).
        """
        marked = [setup for setup in setups if setup.has_markers]
        wrist_setups = [setup for setup in setups if not setup.has_markers]
        rigs = [setup.rig for setup in setups]
        _refuse_two(setups, wrist_setups)
        refuse_shared_senders(rigs)
        gestures_named(rigs)
        if not marked:
            return wrist_setups[0]
        cameras = {name: file for setup in marked for name, file in setup.cameras.items()}
        objects = {one.name: one for setup in marked for one in setup.objects}
        merged = merged_rig([setup.rig for setup in marked])
        out = cls.of(merged, cameras, setups[0].hand, objects or None)
        out = with_fields(out, gestures=_gestures(setups))
        rows = {name: which for setup in marked for name, which in setup.rows.items()}
        if not wrist_setups:
            return with_fields(out, rows=rows)
        return with_fields(
            out,
            cameras=cameras | wrist_setups[0].cameras,
            wrist=wrist_setups[0].wrist,
            wrist_rig=wrist_setups[0].rig,
            rows=rows,
        )


def _check_mounts(rig: RigCalibration, hand: HandModel) -> None:
    """Refuse a marker that is neither the hand's nor free.

    Raises:
        CalibrationError: With its name.
    """
    for name in rig.markers:
        if name not in rig.free_markers:
            try:
                hand.mount(name)
            except CalibrationError as error:
                raise CalibrationError(
                    f"rig {rig.name!r}: {error}; what sits on no hand, as a bead of an object does, stands under "
                    "'free_markers' as well"
                ) from error


def _gestures(setups: Sequence[RigSetup]) -> GestureSettings:
    """Those of the rig that names a file, where one does."""
    named = (setup.gestures for setup in setups if setup.rig.gestures is not None)
    return next(named, setups[0].gestures)


def _refuse_two(setups: Sequence[RigSetup], wrist_setups: Sequence[RigSetup]) -> None:
    """Refuse rigs of different hands, or with conflicting parts.

    Two rigs conflict where both claim what a hand has only once.

    Raises:
        CalibrationError: With both rigs.
    """
    first = setups[0]
    for setup in setups:
        if setup.hand.profile != first.hand.profile:
            raise CalibrationError(
                f"rigs {first.rig.name!r} and {setup.rig.name!r} are of different hands,"
                f" {first.hand.profile.name!r} and {setup.hand.profile.name!r}"
            )
    if len(wrist_setups) > 1:
        raise CalibrationError(
            f"rigs {wrist_setups[0].rig.name!r} and {wrist_setups[1].rig.name!r} are both of kind 'wrist' and of hand"
            f" {first.hand.profile.name!r}: a hand wears one wrist device"
        )
    sensed = [setup.rig.name for setup in setups if setup.rig.imu is not None]
    if len(sensed) > 1:
        raise CalibrationError(
            f"rigs {sensed[0]!r} and {sensed[1]!r} both have an IMU: imu: a hand has one, on the palm or on the forearm"
        )
