"""A wrist scene holds hand, motion, device and the exact laser line.

The sheet of light is a fan of rays from the laser's origin. What each ray meets first is lit, so shadows need no
thought; a lit point is seen where the ray from the camera meets nothing before it. Consecutive rays that meet the
same part of the hand are joined by chords, whose lengths are those of the line. Where a part ends the laser grazes
it, and a little of angle is much of line: there the rays are cast more densely.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, cast, get_args

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.errors import CalibrationError, PhalanxError
from common.geometry.camera_model import CameraModel
from common.geometry.tapered_capsules import Capsules, distances
from common.geometry.transforms import invert, rigid
from common.hand.model import WRIST, HandJoints, HandModel
from common.hand.wrist import STRAIGHT, forearm_palm
from common.sim.motion import HandMotion, HandState
from common.sim.scene import STANDARD_SEED, CameraTiming, optics_of
from common.sim.two_rigs import TWO_RIG_SCENES, two_rig_motion
from common.sim.wrist.capsules import GROUPS, THING_GROUP, HandCapsules, bodies_of
from common.sim.wrist.motion import MOTIONS, wrist_motion

SEEN_WITHIN_M = 2e-4


@dataclass(frozen=True, slots=True, eq=False)
class LaserCurve:
    """Lit points at one time, ray by ray (K,).

    Attributes:
        rays: Unit directions (K, 3) from the laser's origin, along the fan.
        points: (K, 3) [m], camera frame.
        body: Which body is lit (K,).
        group, segment: As in `HandCapsules.parts` (K,).
        seen: Whether the camera sees it (K,).
        joined: (K,) whether it and the next one are neighbours on one part of the hand.
    """

    rays: Float
    points: Float
    body: Int
    group: Int
    segment: Int
    seen: Bool
    joined: Bool


@dataclass(frozen=True, slots=True, eq=False)
class LaserSheet:
    """The fan of one device, and the hand it lights.

    Attributes:
        origin: Where the rays begin (3,) [m], camera frame.
        normal, offset_m: The plane, normal . X = offset_m.
        forward, across: Unit vectors (3,) of the plane: the middle of the fan, and towards its second edge.
        angle_rad: (RAYS,) of the rays to the middle, from one edge of the fan to the other.
        still: The palm of a straight wrist, which was met beforehand.
        still_m: How far along each ray that begins (RAYS,) [m]; inf: nowhere.
        still_body: Which body of it that is (RAYS,).
    """

    origin: Float
    normal: Float
    offset_m: float
    forward: Float
    across: Float
    angle_rad: Float
    capsules: HandCapsules
    still: Capsules
    still_m: Float
    still_body: Int

    @classmethod
    def of(cls, rig: RigCalibration, capsules: HandCapsules, joints: HandJoints) -> "LaserSheet":
        """Of a rig whose palm stands as in `joints` while the wrist is straight.

        Raises:
            CalibrationError: The laser is not known well enough to be simulated.
        """
        laser, plane = rig.laser, rig.laser_plane
        if (
            laser is None
            or plane is None
            or laser.origin is None
            or laser.forward is None
            or laser.fan_rad is None
        ):
            raise CalibrationError(
                f"rig {rig.name!r}: laser.origin, forward, fan_rad and laser_plane: a laser is simulated as it is built"
            )
        normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
        offset = plane.offset_m / float(np.linalg.norm(plane.normal))
        origin = np.array(laser.origin)
        origin = origin + (offset - origin @ normal) * normal  # files are rounded
        forward = np.array(laser.forward) - (np.array(laser.forward) @ normal) * normal
        forward /= np.linalg.norm(forward)
        across = np.cross(normal, forward)
        rays = 1536  # 1.2 mrad apart: 0.2 mm at a finger, half a pixel
        angle = np.linspace(-0.5, 0.5, rays) * laser.fan_rad
        still = capsules.bodies(joints).of(slice(capsules.still))
        near, body = _nearest(distances(still, origin, _fan(forward, across, angle)))
        return cls(origin, normal, offset, forward, across, angle, capsules, still, near, body)

    def cross(self, bodies: Capsules) -> LaserCurve:
        """Intersect the laser sheet with the bodies: the hand, after it the things."""
        capsules, first = self.capsules, self.capsules.still
        rays = _fan(self.forward, self.across, self.angle_rad)
        if capsules.same_palm(bodies, self.still):
            near, body = self._meet(bodies, rays, first)
            body = np.where(near < self.still_m, body, self.still_body)
            near = np.minimum(near, self.still_m)
        else:
            near, body = self._meet(bodies, rays)
        met = np.where(np.isfinite(near), capsules.group_of(body), -1)
        joined_m = 0.004  # longer chords jump from one part to another
        with np.errstate(invalid="ignore"):
            ends = np.flatnonzero((met[1:] != met[:-1]) | (np.abs(np.diff(near)) > joined_m))
        finer = 24  # parts of a gap between rays at the end of a part
        part = np.arange(1, finer) / finer * (self.angle_rad[1] - self.angle_rad[0])
        between = (self.angle_rad[ends][:, None] + part).ravel()
        more = _fan(self.forward, self.across, between)
        more_near, more_body = self._meet(bodies, more)
        order = np.argsort(np.concatenate([self.angle_rad, between]))
        near, body = np.concatenate([near, more_near])[order], np.concatenate([body, more_body])[order]
        lit = np.flatnonzero(np.isfinite(near))
        rays, body = np.concatenate([rays, more])[order][lit], body[lit]
        points = self.origin + near[lit, None] * rays
        group, segment = capsules.parts(bodies, body, points)
        joined = np.zeros(len(lit), dtype=np.bool_)
        chord = np.linalg.norm(np.diff(points, axis=0), axis=1)
        joined[:-1] = (np.diff(lit) == 1) & (group[1:] == group[:-1]) & (chord < joined_m)
        return LaserCurve(rays, points, body, group, segment, self.seen(bodies, points), joined)

    def _meet(self, bodies: Capsules, rays: Float, first: int = 0) -> tuple[Float, Int]:
        """Distances (N,) [m] along rays (N, 3) to the nearest body, and which it is.

        Of the bodies from `first` on; only those that the sheet passes through are tested.
        """
        middle = 0.5 * (bodies.start_m + bodies.stop_m)
        reach = 0.5 * np.linalg.norm(bodies.stop_m - bodies.start_m, axis=1)
        reach += np.maximum(bodies.start_radius_m, bodies.stop_radius_m)
        cut = np.abs(middle @ self.normal - self.offset_m) < reach + SEEN_WITHIN_M
        cut[:first] = False
        which = np.flatnonzero(cut)
        if not which.size:
            return np.full(len(rays), np.inf), np.full(len(rays), first)
        near, body = _nearest(distances(bodies.of(which), self.origin, rays))
        return near, which[body]

    def seen(self, bodies: Capsules, points: Float, within_m: float = SEEN_WITHIN_M) -> Bool:
        """Whether (K,) the camera sees points (K, 3) [m]: at most `within_m` behind."""
        far = np.linalg.norm(points, axis=1)
        front = points[:, 2] > 0.0
        reach = distances(bodies, np.zeros(3), points / far[:, None])
        return front & (reach.min(axis=1) > far - within_m)


def _fan(forward: Float, across: Float, angle_rad: Float) -> Float:
    """Unit directions (N, 3) of rays at angles (N,) to the middle of a fan."""
    return np.cos(angle_rad)[:, None] * forward + np.sin(angle_rad)[:, None] * across


def _nearest(reach: Float) -> tuple[Float, Int]:
    """Of distances (N, B): the least (N,), and whose it is (N,)."""
    body = reach.argmin(axis=1)
    return reach[np.arange(len(reach)), body], body


class LineTruth(NamedTuple):
    """The line by group (7,), as in `WristTruth`."""

    uv: Float
    plane_m: Float
    centroid_m: Float
    seen_m: Float
    lit_m: Float
    segment: Int

    @classmethod
    def of(cls, curve: LaserCurve, optics: CameraModel, sheet: LaserSheet) -> "LineTruth":
        """Sum up the chords on the hand; visible where both ends are seen in the image."""
        uv = optics.project(curve.points)
        size = np.array([optics.width_px, optics.height_px])
        seen = curve.seen & ((uv > -0.5) & (uv < size - 0.5)).all(axis=1)
        chords = np.flatnonzero(curve.joined & (curve.group != THING_GROUP))
        both = seen[chords] & seen[chords + 1]
        group, count = curve.group[chords], len(GROUPS)
        length = np.linalg.norm(curve.points[chords + 1] - curve.points[chords], axis=1)
        lit_m = np.bincount(group, length, count).astype(np.float64)
        chords, group, length = chords[both], group[both], length[both]
        seen_m = np.bincount(group, length, count).astype(np.float64)
        least_m = 2e-4  # of visible line, for a centroid
        enough = seen_m >= least_m

        def mean(value: Float, weight: Float) -> Float:
            middle = 0.5 * (value[chords] + value[chords + 1])
            total = np.bincount(group, weight, count)
            sums = np.stack([np.bincount(group, weight * column, count) for column in middle.T], axis=1)
            with np.errstate(invalid="ignore", divide="ignore"):
                return np.where(enough[:, None], sums / total[:, None], np.nan)

        centre = mean(uv, np.linalg.norm(uv[chords + 1] - uv[chords], axis=1))
        ray = optics.ray(centre)
        by_segment = np.bincount(4 * group + curve.segment[chords], length, 4 * count).reshape(count, 4)
        segment = np.where(seen_m > 0.0, by_segment.argmax(axis=1), -1)
        plane = ray * (sheet.offset_m / (ray @ sheet.normal))[:, None]
        return cls(centre, plane, mean(curve.points, length), seen_m, lit_m, segment)


Ambient = Literal["dark", "indoor", "bright", "sun"]
AMBIENTS: tuple[Ambient, ...] = get_args(Ambient)
WRIST_NAMES = f"{' | '.join((*MOTIONS, *TWO_RIG_SCENES))}, each with @{' | @'.join(AMBIENTS)}"


@dataclass(frozen=True, slots=True, eq=False)
class WristTruth:
    """Complete ground truth of a wrist scene at one time, camera frame.

    Groups are palm, thumb ... little, thenar.

    Attributes:
        t_s: Time [s], scene time.
        angles_rad: (5, 4).
        laser_uv: (7, 2) centroid [px] of the lit and seen part of the laser line, by its length in the image;
            NaN where less than 0.2 mm of it is seen.
        laser_pt: (7, 3) that pixel on the laser plane [m].
        laser_xyz: (7, 3) centroid of the same part by its length in space [m].
        laser_len_vis, laser_len_lit: (7,) length that is lit and seen, length that is lit [m].
        laser_seg: (7,) the segment that carries most of the line (0 metacarpal, 1 proximal ... 3 distal); -1:
            none.
        tip_xyz, tip_uv: (5, 3) [m], (5, 2) [px] outermost point of the skin along each last bone.
        tip_visible: (5,) whether the camera sees that point, or it lies just behind the edge of its own
            finger.
        wrist_angles_rad: (2,) how the wrist is bent (`common.hand.wrist`).
    """

    t_s: float
    angles_rad: Float
    joints: HandJoints
    laser_uv: Float
    laser_pt: Float
    laser_xyz: Float
    laser_len_vis: Float
    laser_len_lit: Float
    laser_seg: Int
    tip_xyz: Float
    tip_uv: Float
    tip_visible: Bool
    wrist_angles_rad: Float


@dataclass(frozen=True, slots=True, eq=False)
class WristScene:
    """Hand, motion, light and the device on its forearm; rig frame = camera frame.

    Attributes:
        rig: Laser, LEDs, palm pose.
        motion: How it moves; its `T_rig_palm` is the palm's way through the room, which with the bend of the
            wrist is that of the forearm, where camera and IMU sit.
        ambient: The light of the room.
        seed: Of hand, skin, room and noise.
        reflectance: How much light the skin gives back, of whatever light, against usual skin.
        T_camera_palm: (4, 4) of a straight wrist [m].
    """

    rig: RigCalibration
    cameras: Mapping[str, CameraCalibration]
    model: HandModel
    motion: HandMotion
    ambient: Ambient = "indoor"
    seed: int = STANDARD_SEED
    reflectance: float = 1.0
    optics: CameraModel = field(init=False)
    capsules: HandCapsules = field(init=False)
    sheet: LaserSheet = field(init=False)
    T_camera_palm: Float = field(init=False)
    _straight: HandJoints = field(init=False)

    def __post_init__(self) -> None:
        where = f"rig {self.rig.name!r}"
        if self.rig.kind != "wrist":
            raise CalibrationError(f"{where}: kind is {self.rig.kind!r}; a wrist scene needs 'wrist'")
        optics = optics_of(self.rig, self.cameras)[self.rig.cameras[0]]
        for key in ("laser_plane", "laser", "T_camera_palm", "led"):
            if not getattr(self.rig, key):
                raise CalibrationError(f"{where}: {key}: missing; a wrist device is simulated as it is built")
        if not 0.0 < self.reflectance < np.inf:
            raise CalibrationError(
                f"{where}: reflectance {self.reflectance}: expected a positive number, 1 is usual"
            )
        object.__setattr__(self, "optics", optics)
        object.__setattr__(self, "T_camera_palm", np.array(self.rig.T_camera_palm, dtype=np.float64))
        object.__setattr__(self, "capsules", HandCapsules.of(self.model, self.seed))
        straight = self.model.forward(self.T_camera_palm, np.zeros((5, 4)))
        object.__setattr__(self, "_straight", straight)
        object.__setattr__(self, "sheet", LaserSheet.of(self.rig, self.capsules, straight))

    @classmethod
    def by_name(
        cls,
        name: str,
        rig: RigCalibration,
        cameras: Mapping[str, CameraCalibration],
        hand: HandProfile,
        seed: int = STANDARD_SEED,
    ) -> "WristScene":
        """Create the scene called MOTION or MOTION@AMBIENT.

        A motion of `TWO_RIG_SCENES` is also that of a marker rig.

        Raises:
            PhalanxError: No such motion or light; a rig, camera or hand that does not fit.
        """
        moves, _, ambient = name.partition("@")
        model = HandModel.of(hand)
        motion = wrist_motion(moves, model, seed) or two_rig_motion(moves, model, np.zeros(3), seed)
        if motion is None or (ambient or "indoor") not in AMBIENTS:
            raise PhalanxError(f"scene {name!r}: for a wrist rig there are {WRIST_NAMES}")
        return cls(rig, cameras, model, motion, cast(Ambient, ambient or "indoor"), seed)

    @property
    def period_s(self) -> float:
        """Time [s] after which the scene repeats."""
        return self.motion.period_s

    def timing(self, camera: str) -> CameraTiming:
        """How the camera's frames lie in time: there is one, and its clock is right."""
        self.rig.cameras.index(camera)
        return CameraTiming(0, 0.0)

    def bodies_of(self, state: HandState) -> Capsules:
        """Bodies that camera and laser meet of a hand in that state: hand, things."""
        return self._bodies(state, self._joints(state))

    def straight_bodies(self, wrist_angles_rad: Float = STRAIGHT) -> Capsules:
        """Bodies of straight fingers with the wrist flexed by (2,) [rad], camera frame."""
        return self.bodies_of(HandState(np.eye(4), np.zeros((5, 4)), wrist_angles_rad))

    def truth(self, t_s: float) -> WristTruth:
        """Exact state at scene time `t_s` [s]; before 0 the pose of 0."""
        state = self.motion.at(t_s)
        joints = self._joints(state)
        bodies = self._bodies(state, joints)
        line = LineTruth.of(self.sheet.cross(bodies), self.optics, self.sheet)
        tips = self.capsules.tips(bodies)
        tip_within_m = 0.003  # a tip 12 degrees behind the edge of its own round end is visible
        return WristTruth(
            t_s,
            state.angles_rad,
            joints,
            *line,
            tips,
            self.optics.project(tips),
            self.sheet.seen(bodies, tips, tip_within_m),
            state.wrist_angles_rad,
        )

    def _joints(self, state: HandState) -> HandJoints:
        """Where the camera, which sits on the forearm, sees them."""
        T = self.T_camera_palm
        if state.wrist_angles_rad.any():
            T = T @ rigid(forearm_palm(state.wrist_angles_rad), np.zeros(3))
        return self.model.forward(T, state.angles_rad)

    def _bodies(self, state: HandState, joints: HandJoints) -> Capsules:
        R_straight = self._straight.rotation[WRIST] if state.wrist_angles_rad.any() else None
        capsules = self.capsules.bodies(joints, R_straight)
        if not state.things:
            return capsules
        return capsules.before(bodies_of(state.things, joints.T_rig_palm @ invert(state.T_rig_palm)))
