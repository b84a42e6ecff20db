"""From JSON to pipeline: reads rigs and what they name of a calibration folder, and joins the parts."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as with_fields
from math import nan
from pathlib import Path
from typing import Protocol, cast

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.camera_model import CameraModel
from common.errors import CalibrationError
from common.geometry import cross
from common.gesture_settings import GestureSettings, default_gestures
from common.hand_model import HandModel
from common.messages import Detections, MarkerDetections
from common.object_profile import ObjectProfile
from master.filters import OneEuroParameters, PointFilter
from master.fusion.pipeline import FusedPipeline, WristSide
from master.hurry import never
from master.ik.hand_filter import HandFilter
from master.ik.tracker import HandTracker
from master.rig_merge import gestures_named, merged_rig, refuse_shared_senders, rigs_by_hand
from master.rig_objects import load_gestures, load_objects, objects_of, refuse_shared_objects
from master.stereo.depth import depth_law
from master.stereo.pairing import Pairing
from master.stereo.pipeline import MarkerPipeline, OtherSensors, SolvedPose, Stage
from master.stereo.place import CalibrationResidual
from master.wrist.pipeline import WristPipeline
from master.wrist.setup import WristSetup

_LEAD_M_S = 0.12  # of a palm, and of a finger on it, when another sensor takes over: 4 mm a frame at 60 Hz


class Pipeline(Protocol):
    """What makes poses of what the cameras of one rig saw, whichever kind of rig it is: a push machine."""

    counts: Counter[str]

    def push(self, message: Detections) -> list[SolvedPose]:
        """Take one camera's detections; return the poses they complete, oldest first."""
        ...

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take what the IMU says of its own orientation (4,)."""
        ...

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait for something."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class RigSetup:
    """What watches one hand, with everything the files refer to, checked: a marker rig, a wrist device, or both.

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
        """The cameras that send strobed triples and no markers."""
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
            rival_uv=message.rival_uv[chosen],
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
        """All that watches one hand: its marker rigs become one of N cameras in the frame that they share
        (`T_world_rig`), and its wrist device stands beside them.

        Args:
            setups: One or more, of one hand.

        Raises:
            CalibrationError: They are of different hands, two are wrist devices, two have a camera or IMU of the same
                name or two IMUs, name two files of gestures, or the marker rigs cannot be merged (`merged_rig`).
        """
        marked = [setup for setup in setups if setup.has_markers]
        worn = [setup for setup in setups if not setup.has_markers]
        rigs = [setup.rig for setup in setups]
        _refuse_two(setups, worn)
        refuse_shared_senders(rigs)
        gestures_named(rigs)
        if not marked:
            return worn[0]
        cameras = {name: file for setup in marked for name, file in setup.cameras.items()}
        objects = {one.name: one for setup in marked for one in setup.objects}
        merged = merged_rig([setup.rig for setup in marked])
        out = cls.of(merged, cameras, setups[0].hand, objects or None)
        out = with_fields(out, gestures=_gestures(setups))
        rows = {name: which for setup in marked for name, which in setup.rows.items()}
        if not worn:
            return with_fields(out, rows=rows)
        return with_fields(
            out, cameras=cameras | worn[0].cameras, wrist=worn[0].wrist, wrist_rig=worn[0].rig, rows=rows
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


def _refuse_two(setups: Sequence[RigSetup], worn: Sequence[RigSetup]) -> None:
    """Refuse rigs that are not of one hand, or of which two claim what a hand has once.

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
    if len(worn) > 1:
        raise CalibrationError(
            f"rigs {worn[0].rig.name!r} and {worn[1].rig.name!r} are both of kind 'wrist' and of hand"
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
    """What watches each hand of these rigs, in the order in which they name the hands.

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
    """Read rigs/<rig>.json of each rig, their cameras, hands, objects and gestures from a calib_json tree: a setup for
    each hand.

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
    """As `setups_of`, each hand, object and gesture as `load_hand`, `load_objects` and `load_gestures` find it.

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
    """Read rigs/<rig>.json, its cameras, hand, objects and gestures from a calib_json tree.

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


def point_filter(setup: RigSetup) -> PointFilter:
    """The filter this rig's file describes, along the mean sight of its cameras and across it."""
    settings = setup.rig.filter
    poses = np.array([model.T_rig_camera for model in setup.models.values()])
    ahead = poses[:, :3, 2].sum(axis=0)
    across = cross(poses[0, :3, 1], ahead)
    view = np.stack([across, cross(ahead, across), ahead])
    return PointFilter(
        OneEuroParameters(settings.min_cutoff_hz, settings.beta, settings.d_cutoff_hz),
        settings.jitter_m,
        view / np.linalg.norm(view, axis=1, keepdims=True),
    )


def hand_filter(setup: RigSetup) -> HandFilter:
    """The filter of the solved hand, which leaves no more jitter than that of the points may."""
    lead_m_s = None if setup.wrist is None else _LEAD_M_S
    return HandFilter(setup.hand, setup.hand_markers, setup.rig.filter.jitter_m, lead_m_s)


def build_pipeline(
    setup: RigSetup,
    stage: Stage,
    *,
    continuous: bool = True,
    tracker: HandTracker | None = None,
    others: OtherSensors | None = None,
    counts: Counter[str] | None = None,
    shed: Callable[[], bool] = never,
) -> MarkerPipeline:
    """The pipeline this marker rig's file describes; of a wrist device beside it nothing is used but through `others`.

    Args:
        setup: The rig.
        stage: Measures the stages.
        continuous: False: every frame is an unrelated pose; no filter, no memory.
        tracker: Tracks the hand; None: a new one, which takes most of the time.
        others: What else watches the hand; None: nothing does.
        counts: Counted into; None: counts of its own.
        shed: Asked for each instant whether it is left out.

    Raises:
        CalibrationError: The depth model does not fit the rig, or it is no marker rig.
    """
    if not setup.has_markers:
        raise CalibrationError(f"rig {setup.rig.name!r}: kind is 'wrist', this needs a rig of 'markers'")
    rates = {name: setup.cameras[name].frame_rate_hz for name in setup.models}
    return MarkerPipeline(
        setup.models,
        setup.hand,
        setup.rig.markers,
        pairing=Pairing(setup.models, rates, policy=setup.rig.pairing, continuous=continuous),
        law=depth_law(setup.rig),
        residual=CalibrationResidual.of(setup.rig),
        smooth=point_filter(setup) if continuous else None,
        tracker=HandTracker(setup.hand, setup.hand_markers, continuous=continuous)
        if tracker is None
        else tracker,
        steady=hand_filter(setup) if continuous else None,
        stamp_offset_us=setup.rig.stamp_offset_us,
        volume=setup.rig.volume,
        imu=setup.rig.imu,
        others=others,
        counts=counts,
        stage=stage,
        shed=shed,
    )


def pipeline_of(
    setup: RigSetup,
    stage: Stage,
    *,
    continuous: bool = True,
    tracker: HandTracker | None = None,
    shed: Callable[[], bool] = never,
) -> Pipeline:
    """The pipeline of a rig of either kind, or of both; arguments and errors as of `build_pipeline`.

    A wrist device alone has no tracker. What is pushed is of cameras of these rigs: the link refuses one that sends
    what those of the other kind do.
    """
    if setup.wrist is None:
        return cast(Pipeline, build_pipeline(setup, stage, continuous=continuous, tracker=tracker, shed=shed))
    try:
        if setup.has_markers:
            side = WristSide.of(setup.wrist, counts := Counter[str](), stage, continuous=continuous)
            markers = build_pipeline(
                setup, stage, continuous=continuous, tracker=tracker, others=side, counts=counts, shed=shed
            )
            return FusedPipeline(
                markers, side, min(setup.cameras[name].frame_rate_hz for name in setup.models)
            )
        return cast(Pipeline, WristPipeline(setup.wrist, continuous=continuous, stage=stage))
    except CalibrationError as error:
        raise CalibrationError(f"rig {setup.rig.name!r}: {error}") from error
