"""A wrist device, alone or beside marker cameras and an IMU.

All are push machines without clock, socket or thread: live and offline runs push the same messages and get
the same poses. `WristPipeline`: strobe cycles -> rows -> estimator -> pose, of a device alone. The rig's
frame is the camera's, so the palm stands where calibration found it. A finger that was not seen for half a
second is not valid, and NaN. `WristSide`: an epoch of the cameras uses rows of the strobe cycle before
it, if there is a new one, and how the IMU has the forearm turned; where the cameras are silent, epochs are
those of the strobe cycles. A silent sensor adds no row: there is no state in which one is used and another
not.

The IMU measures how the forearm lies in a world of its own, whose z axis is up; the hand hangs on it by the
wrist:

    R_rig_palm = R_rig_world exp(tilt) R_z(heading) R_world_forearm R_forearm_palm(bend)

`imu.q_rig_world` states where up is in the rig. Tilt, heading and bend are unknowns of the estimator
(`master.estimator.state`); `Forearm` has samples, sessions and clocks. An IMU that restarts lies in a new
world, and the heading begins anew. Mostly it shows: silent for a while, it begins to count its drift again.
If not, palms that contradict for long reveal it.
"""

from collections import Counter, deque
from contextlib import nullcontext
from math import atan2, cos, hypot, isnan, nan, pi, sin, sqrt

import msgspec
import numpy as np

from common.arrays import Bool, Code, Float
from common.calibration import ImuCalibration
from common.geometry.transforms import Wxyz, matrix_of, matrix_to_quaternion, quaternion_product
from common.hand.model import CHAINS
from common.hand.wrist import wrist_quaternion
from common.kernels import bound
from common.messages import HandPose, Source, WristDetections
from master.estimator.epoch import (
    CycleReader,
    Epoch,
    Fitted,
    MarkerPositions,
    OrientationMeasurement,
    count_fingers,
)
from master.estimator.estimator import Estimator, pose_of
from master.estimator.kinematics import quaternions
from master.estimator.pipeline import (
    Between,
    OrientationSamples,
    SolvedPose,
    Stage,
    rotation_of,
)
from master.estimator.posterior import ON_MARKERS
from master.estimator.priors import WristModel, loosened
from master.estimator.sensors import HEADING, TILT, WRIST_ANGLES, WristRows
from master.estimator.settings import DEFAULT, Settings
from master.fabrik.settings import NEVER_NS
from master.rig.setup import WristSetup

ANYWHERE_RAD = pi / sqrt(3.0)  # standard deviation of a uniform circle
_EYE = np.eye(3)
_WRIST = slice(WRIST_ANGLES, WRIST_ANGLES + 2)
NO_WORLD = np.full(4, np.nan), np.full(2, np.nan)


class Forearm:
    """Push machine. Holds the samples of an IMU, and since when palms contradict it.

    `lost`: whether the IMU began anew since `orientation_at` was asked. Counts `orientation.used`, epochs
    that had a sample, `orientation.absent`, those farther than 50 ms from any; samples rejected, as of
    `OrientationSamples`; `forearm.begun`, how often the heading began anew, and `forearm.outlier`, palms that
    contradicted it.
    """

    def __init__(self, imu: ImuCalibration, counts: Counter[str] | None = None) -> None:
        """Follow the IMU of a rig file, counting into `counts` if given.

        Raises:
            CalibrationError: The file does not state how it is mounted.
        """
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._imu, self._imu_forearm = imu, _wxyz(rotation_of("q_palm_imu", imu.q_palm_imu).T)
        self._rig_world = (
            None if imu.q_rig_world is None else _wxyz(rotation_of("q_rig_world", imu.q_rig_world))
        )
        self._samples = OrientationSamples(self.counts, imu.heading_drift_rad_s, imu.stamp_offset_us)
        self._sample_ns, self._sample_drift_rad = 0, nan
        self._asked_ns: int | None = None
        self._drift_rad = 0.0
        self._contrary_ns: list[int] = []
        self.lost = False

    @property
    def placed(self) -> bool:
        """Return whether the file states where up is in the rig."""
        return self._rig_world is not None

    def push(self, t_ns: int, wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take one sample (4,), IMU axes -> its world, and its heading drift if known."""
        self._samples.push(t_ns, wxyz, heading_sigma_rad)
        if isnan(sum(wxyz.tolist())):
            return
        silent_s = 1e-9 * abs(t_ns - self._sample_ns)
        if silent_s > DEFAULT.restarted_s and heading_sigma_rad < self._sample_drift_rad:
            # A drift does not shrink in silence: the IMU counts from a new beginning, in a new world.
            self.lost, self._drift_rad = True, heading_sigma_rad
        self._sample_ns, self._sample_drift_rad = t_ns, heading_sigma_rad

    def orientation_at(self, t_ns: int, z: Float, z_cov: Float) -> OrientationMeasurement | None:
        """Return how the forearm turns the palm; None: no sample near, or world unplaced."""
        found = self._between(t_ns)
        if found is None or self._rig_world is None:
            return None
        process_noise = self._process_noise_rad2(t_ns, found)
        tilted, half_heading = self._tilted(self._rig_world, z), 0.5 * float(z[HEADING])
        heading = cos(half_heading), 0.0, 0.0, sin(half_heading)
        rotation = matrix_of(quaternion_product(quaternion_product(tilted, heading), self._forearm(found)))
        sigma = hypot(DEFAULT.strap_rad, DEFAULT.palm_process_noise_rad_s * found.gap_s)
        axes = matrix_of(self._rig_world).T.copy()  # about x and y of the world the forearm tilts,
        axes[2] = matrix_of(tilted)[:, 2]  # about the estimated vertical it turns
        wide = z_cov[HEADING, HEADING] + process_noise + np.trace(z_cov[_WRIST, _WRIST])
        return OrientationMeasurement(
            rotation, _EYE / sigma**2, bool(wide < DEFAULT.sure_rad**2), axes, process_noise
        )

    def heading_of(self, t_ns: int, R_rig_palm: Float, z: Float) -> float | None:
        """The heading that comes nearest to a palm (3, 3) [rad]; None: no sample is near."""
        found = self._samples.between(t_ns)
        if found is None or self._rig_world is None:
            return None
        flexion, deviation = z[_WRIST].tolist()
        palm = matrix_of(quaternion_product(self._forearm(found), wrist_quaternion(flexion, deviation)))
        rotation = matrix_of(self._tilted(self._rig_world, z)).T @ R_rig_palm @ palm.T
        return atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])

    def contradicted(self, t_ns: int, *, by_palm: bool) -> bool:
        """Note if the palm contradicts the forearm; return if it did so for long."""
        if not by_palm:
            self._contrary_ns.clear()
            return False
        self.counts["forearm.outlier"] += 1
        self._contrary_ns.append(t_ns)
        long = abs(t_ns - self._contrary_ns[0]) > round(1e9 * DEFAULT.contrary_s)
        return long and len(self._contrary_ns) >= DEFAULT.contrary_palms

    def world_at(self, t_ns: int, wrist_angles_rad: Float, wrist_cov: Float) -> tuple[Float, Float]:
        """Return the palm orientation at a time in the IMU's own world; needs no heading.

        Of wrist angles (2,), cov (2, 2): a quaternion (4,), palm axes -> the IMU's world, and standard
        deviations (2,) [rad]: tilt per axis, heading; NaN: not known.
        """
        found = self._between(t_ns)
        if found is None:
            return NO_WORLD
        half_heading = DEFAULT.palm_process_noise_rad_s * found.gap_s
        forearm, (flexion, deviation) = self._forearm(found), wrist_angles_rad.tolist()
        (ff, fd), (_, dd) = wrist_cov.tolist()
        c, s = cos(deviation), sin(deviation)
        # Along each axis of the world: what a flexion, about the forearm's x as it deviates, and a deviation leave.
        about = [(c * x - s * z, y) for x, y, z in matrix_of(forearm).tolist()]
        x, y, z = (u * u * ff + 2.0 * u * v * fd + v * v * dd for u, v in about)
        tilt = hypot(self._imu.orientation_sigma_rad, half_heading, sqrt(0.5 * (x + y)))
        heading = hypot(self._imu.heading_sigma_rad or 0.0, found.drift_rad, half_heading, sqrt(z))
        palm = np.array(quaternion_product(forearm, wrist_quaternion(flexion, deviation)))
        return -palm if palm[0] < 0.0 else palm, np.array([tilt, min(heading, ANYWHERE_RAD)])

    def _between(self, t_ns: int) -> Between | None:
        found = self._samples.between(t_ns)
        self.counts["orientation.absent" if found is None else "orientation.used"] += 1
        return found

    def _forearm(self, found: Between) -> Wxyz:
        """The forearm in the IMU's world."""
        return quaternion_product(found.q_wxyz, self._imu_forearm)

    @staticmethod
    def _tilted(rig_world: Wxyz, z: Float) -> Wxyz:
        """Return the IMU's world in the rig, tilted by the estimated tilt."""
        x, y = z[TILT : TILT + 2].tolist()
        angle = hypot(x, y)
        small_rad = 1e-9  # a tilt by less is taken as small
        share = sin(0.5 * angle) / angle if angle > small_rad else 0.5
        return quaternion_product(rig_world, (cos(0.5 * angle), share * x, share * y, 0.0))

    def _process_noise_rad2(self, t_ns: int, found: Between) -> float:
        """Variance [rad^2] of what the heading has drifted since the epoch before.

        Drifts that a filter reports are mostly an unknown bias, whose variance grows with the square of the
        time. Of a long silence that counts; from epoch to epoch it is a walk, of as much as can be followed.
        """
        since_s = 0.0 if self._asked_ns is None else 1e-9 * abs(t_ns - self._asked_ns)
        even_rad = abs(found.drift_rad - self._drift_rad)
        process_noise = found.drift_rad**2 - self._drift_rad**2
        least, most = DEFAULT.heading_least_rad_s**2 * since_s, DEFAULT.heading_most_rad_s**2 * since_s
        if found.drift_rad >= ANYWHERE_RAD:  # as much as is ever reported
            even_rad, process_noise = max(even_rad, self._imu.heading_drift_rad_s * since_s), most
        self._asked_ns, self._drift_rad = t_ns, found.drift_rad
        return float(max(even_rad**2, min(max(process_noise, least), most)))


def _wxyz(rotation: Float) -> Wxyz:
    """The unit quaternion of a rotation (3, 3)."""
    w, x, y, z = matrix_to_quaternion(rotation).tolist()
    return w, x, y, z


_ORIENTATION_INFO = np.eye(3) * DEFAULT.stands_rad**-2.0
_PALM = np.setdiff1d(np.arange(26), CHAINS)
_NO_AXES = np.zeros((3, 3))
_NO_POINTS, _NO_COV, _NO_FLAGS = np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, np.bool_)
_NO_MARKERS = MarkerPositions(_NO_POINTS, _NO_COV, _NO_COV, _NO_FLAGS, _NO_FLAGS[None])
_STRAIGHT = np.zeros(2), np.zeros((2, 2))


class WristPipeline:
    """Push machine. Holds the estimator and when each finger was seen last."""

    def __init__(
        self,
        setup: WristSetup,
        *,
        continuous: bool = True,
        stage: Stage = lambda name: nullcontext(),
        settings: Settings = DEFAULT,
    ) -> None:
        """Join the parts; not `continuous`: no memory but of what is constant."""
        self.counts: Counter[str] = Counter()
        self._setup, self._stage, self._continuous = setup, stage, continuous
        self._model, self._hand = WristModel.of(setup, loose=False), loosened(setup.model)
        self._estimator = Estimator(
            (setup.optics,), self._hand, (), (), continuous=continuous, settings=settings, wrist=self._model
        )
        bound(quaternions, np.empty((26, 3, 3)), np.empty((26, 4)))  # compiles it here, so that no pose waits
        self._reader = CycleReader(setup, self.counts)
        T = setup.T_camera_palm
        self._orientation = OrientationMeasurement(
            np.ascontiguousarray(T[:3, :3]), _ORIENTATION_INFO, sure=True, axes=_NO_AXES
        )
        self._place = np.ascontiguousarray(T[:3, 3])
        self._forearm = None if setup.imu is None else Forearm(setup.imu, self.counts)
        self._last_ns, self._seen_ns = NEVER_NS, np.full(5, NEVER_NS)
        self._forget_ns = round(1e9 * settings.forget_s)

    def push(self, message: WristDetections) -> list[SolvedPose]:
        """Solve one strobe cycle; one not later than the last is counted and dropped."""
        t_ns = message.t_ns + self._setup.late_ns
        if t_ns <= self._last_ns:
            self.counts["late"] += 1
            return []
        self._last_ns = t_ns
        with self._stage("laser"):
            rows, laser_m = self._reader.read(message, t_ns)
        with self._stage("hand"):
            hand = self._estimator.push(
                Epoch(
                    t_ns,
                    _NO_POINTS,
                    np.zeros(3),
                    orientation=self._orientation,
                    wrist=rows,
                    place=self._place,
                )
            )
            pose = self._pose(t_ns, hand, laser_m)
        self.counts["poses"] += 1
        return [SolvedPose(pose, message.ready_t_ns)]

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take the IMU's orientation (4,): the forearm, and the palm, in its world."""
        if self._forearm is None:
            self.counts["orientation.unplaced"] += 1
        else:
            self._forearm.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: nothing waits."""
        return []

    def _pose(self, t_ns: int, hand: Fitted, laser_m: Float) -> HandPose:
        """The message of a hand; fingers that were not seen lately are not valid."""
        world = NO_WORLD if self._forearm is None else self._forearm.world_at(t_ns, *_STRAIGHT)
        measured: Bool = hand.solver_mode > 0
        self._seen_ns[measured] = t_ns
        known: Bool = t_ns - self._seen_ns <= (self._forget_ns if self._continuous else 0)
        for event, fingers in (
            ("tip_refused", hand.refused),
            ("off", hand.off),
            ("ambiguous", hand.ambiguous),
            ("held", known & ~measured),
            ("unseen", ~known),
        ):
            count_fingers(self.counts, event, fingers)
        if hand.solution is not None:
            hand.valid[:] = True
            if not known.all():
                lost, joints = CHAINS[~known].ravel(), hand.solution.joints
                hand.valid[lost], hand.tracked[lost], hand.source[lost] = False, False, Source.NONE
                joints.position_m[lost], joints.rotation[lost], hand.solution.cov_m2[lost] = nan, nan, nan
                hand.solution.angles_rad[~known] = nan
            hand.tracked[_PALM], hand.source[_PALM] = hand.tracked[CHAINS[measured]].any(), Source.WRIST
        pose = pose_of(hand, self._hand, t_ns, _NO_MARKERS.points_m, _NO_MARKERS, self._setup.volume)
        return msgspec.structs.replace(
            pose,
            laser_m=laser_m,
            palm_world_wxyz=world[0],
            palm_world_sigma_rad=world[1],
            solver_mode=hand.solver_mode,
            ambiguous=hand.ambiguous,
        )


_MAX_AGE_NS, _APART_NS = round(1e9 * DEFAULT.cycle_age_s), round(1e9 * DEFAULT.cycle_apart_s)


class WristSide:
    """Push machine that holds strobe cycles that wait for an epoch, and IMU samples.

    `forearm`: of the IMU; None: there is none, or it is not known how it is mounted or placed.
    """

    def __init__(self, setup: WristSetup, counts: Counter[str], *, continuous: bool) -> None:
        """Join the parts.

        `counts` are by event and finger: `late`, `outside`, `no_plane`, `tip_refused`, `off`, `ambiguous`;
        and as of `Forearm`. `continuous`: False: every message is an unrelated pose.
        """
        self.counts, self._setup, self._continuous = counts, setup, continuous
        forearm = None if setup.imu is None else Forearm(setup.imu, counts)
        self.forearm = forearm if forearm is not None and forearm.placed else None
        self._reader = CycleReader(setup, counts)
        self._waiting: deque[WristDetections] = deque(maxlen=round(DEFAULT.cycles))
        self._last_ns = NEVER_NS
        self.laser_m, self.laser_ns = np.full((5, 3), nan), NEVER_NS
        self.solver_mode, self.ambiguous = np.zeros(5, np.uint8), np.zeros(5, np.bool_)

    def push(self, message: WristDetections) -> int | None:
        """Take a strobe cycle and return its time; None: it is not after the last."""
        t_ns = message.t_ns + self._setup.late_ns
        if t_ns <= self._last_ns:
            self.counts["late"] += 1
            return None
        self._last_ns = t_ns
        self._waiting.append(message)
        return t_ns

    def rows_at(self, t_ns: int) -> WristRows | None:
        """Return the rows of the newest unused strobe cycle, for an epoch; None: none."""
        late_ns, message = self._setup.late_ns, None
        if not self._continuous:
            near = min(self._waiting, key=lambda one: abs(one.t_ns + late_ns - t_ns), default=None)
            message = near if near is not None and abs(near.t_ns + late_ns - t_ns) <= _APART_NS else None
        else:
            while self._waiting and self._waiting[0].t_ns + late_ns <= t_ns:
                message = self._waiting.popleft()
            if message is not None and t_ns - message.t_ns - late_ns > _MAX_AGE_NS:
                message = None
        if message is None:
            return None
        rows, self.laser_m = self._reader.read(message, t_ns)
        self.laser_ns = message.t_ns + late_ns
        return rows

    def orientation_at(self, t_ns: int, estimator: Estimator) -> OrientationMeasurement | None:
        """Return the IMU's palm orientation; None: not reported, or any heading."""
        if self.forearm is None:
            return None
        if self.forearm.lost:
            self.forearm.lost = False
            estimator.forget_heading()
        orientation = self.forearm.orientation_at(t_ns, estimator.extras, estimator.extras_cov)
        unknown = estimator.extras_cov[HEADING, HEADING] > DEFAULT.heading_lost_rad**2
        return None if unknown else orientation

    def solved(self, t_ns: int, hand: Fitted, estimator: Estimator, *, oriented: bool) -> None:
        """Learn from an epoch; `oriented`: it had a TURN row to begin with."""
        if hand.solver_mode.any():
            self.solver_mode, self.ambiguous = hand.solver_mode, hand.ambiguous
        count_fingers(self.counts, "tip_refused", hand.refused)
        count_fingers(self.counts, "off", hand.off)
        count_fingers(self.counts, "ambiguous", hand.ambiguous)
        if self.forearm is None or hand.solution is None or not hand.sources[5] & ON_MARKERS:
            return
        if oriented and self.forearm.contradicted(t_ns, by_palm=hand.rotation_rejected):
            estimator.forget_heading()
            oriented = False
        if oriented:
            return
        heading = self.forearm.heading_of(t_ns, hand.solution.T_rig_palm[:3, :3], estimator.extras)
        if heading is not None:
            self.counts["forearm.begun"] += 1
            rotation_cov = hand.solution.measurement_cov[:3, :3]
            variance_rad2 = np.trace(estimator.extras_cov[_WRIST, _WRIST]) + np.trace(rotation_cov)
            estimator.begin_heading(heading, float(variance_rad2))

    def completed(self, pose: HandPose, estimator: Estimator) -> HandPose:
        """The pose with what else is known of the hand."""
        changes: dict[str, Float | Code | Bool] = {}
        if self.forearm is not None:
            wrist_angles = estimator.extras[_WRIST].copy()
            cov = estimator.extras_cov[_WRIST, _WRIST]
            changes["wrist_angles_rad"] = wrist_angles
            changes["wrist_angles_sigma_rad"] = np.sqrt(np.diag(cov))
            world = self.forearm.world_at(pose.t_ns, wrist_angles, cov)
            changes["palm_world_wxyz"], changes["palm_world_sigma_rad"] = world
        if abs(pose.t_ns - self.laser_ns) <= _MAX_AGE_NS:
            changes["laser_m"] = self.laser_m
            changes["solver_mode"], changes["ambiguous"] = self.solver_mode, self.ambiguous
        return msgspec.structs.replace(pose, **changes)
