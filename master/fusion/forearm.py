"""The palm by an IMU that sits on the forearm: its heading and the bend of the wrist are learnt from markers.

The IMU tells how the forearm lies in a world of its own; the hand hangs on it by the wrist. `imu.q_rig_world` says
where up is in the rig; the heading about it is nobody's until markers have told it, and drifts from then on. The filter
is that of `master.fusion.forearm_state`; here is what comes and goes: samples, palms, sessions and clocks.

While nobody sees the palm, the bend goes back to its habit, as far as that is known, and its doubt grows to that of
wrists in general; the heading drifts. Nothing is switched. A palm that is quite unlikely is left out.

An IMU that restarts lies in a new world. Mostly it tells so: silent for a while, it begins to count its drift again. If
not, palms that contradict for long say it, where the heading jumped by much. Where by little, that looks like a bend:
so a rival that began lately, with any heading, learns beside, and takes over once it foretells the palms far better.
"""

from collections import Counter
from math import hypot, isnan, nan, sqrt

import numpy as np

from common.arrays import Float
from common.calibration import ImuCalibration
from common.geometry import matrix_to_quaternion, quaternion_to_matrix
from common.wrist_bend import forearm_palm
from master.estimator.settings import DEFAULT
from master.fusion.forearm_state import (
    ANYWHERE_RAD,
    HEADING,
    TELLS_RAD,
    ForearmState,
    SeenForearm,
    bend_axes,
)
from master.fusion.orientation import Orientation, turn_of
from master.fusion.orientation_samples import Between
from master.fusion.told_forearm import ToldForearm
from master.wrist.palm_world import NO_WORLD, PalmWorld

_LOST_RAD = 1.0  # a heading less sure than this may point anywhere
_WALK2, _MOST2 = np.radians([0.2, 5.0]) ** 2  # [rad^2/s] a heading walks at least and, unless evenly, at most
_CONTRARY_NS, _CONTRARY = 500_000_000, 5  # what contradicts for so long, and so often, is right
_LEAD, _BEHIND = 10.0, -1.0  # logarithm of how much likelier a rival has to be, and when it gives up
_RIVAL_NS = 10_000_000_000  # or after such a time
_RESTARTED_S = 0.25  # an IMU that begins anew is silent for longer, until it knows where up is
_CLOCK_NS = -1_000_000_000  # what is so much older than the last is not late: a clock was set back


class Forearm:
    """Push machine. Holds the samples of an IMU, tilt, heading and bend as of the last palm, and what contradicts them.

    Attributes:
        counts: `forearm.seen`, instants that were taken; left out: `forearm.missing` (numbers), `forearm.alone` (no
            sample near), `forearm.late`, `forearm.vague` (tells next to nothing), `forearm.outlier`; `forearm.begun`,
            how often the heading was learnt from nothing; and those of `PalmWorld`.
    """

    def __init__(self, imu: ImuCalibration, counts: Counter[str] | None = None) -> None:
        """Follow the IMU of a rig file, counting into `counts` if given.

        Raises:
            CalibrationError: The file does not say how it is mounted, or where up is in the rig (`q_rig_world`).
        """
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._world = PalmWorld(imu, self.counts)
        self._imu_forearm = turn_of("q_palm_imu", imu.q_palm_imu).T
        rig_world = turn_of("q_rig_world", imu.q_rig_world)
        self._even_rad_s = imu.heading_drift_rad_s
        heading_rad = ANYWHERE_RAD if imu.heading_sigma_rad is None else imu.heading_sigma_rad
        self._state = ForearmState.of(rig_world, imu.orientation_sigma_rad, heading_rad)
        self._t_ns: int | None = None
        self._drift_rad = 0.0
        self._sample_ns, self._sample_drift_rad = 0, nan
        self._contrary_ns: list[int] = []
        self._rival: ForearmState | None = None
        self._rival_ns, self._lead = 0, 0.0

    @property
    def heading_rad(self) -> float:
        """The turn about the vertical [rad] that `q_rig_world` lacks, as of the last palm."""
        return float(self._state.mean[HEADING])

    @property
    def heading_sigma_rad(self) -> float:
        """Its standard deviation as of the newest sample, 1.8 or more if it may be anywhere."""
        found = self._world.samples.between(self._sample_ns)
        walked = 0.0 if found is None else self._walked_rad2(self._sample_ns, found)
        return sqrt(self._state.cov[HEADING, HEADING] + walked)

    def push(self, t_ns: int, wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take one sample: quaternion (4,), IMU axes -> its world, and how far its heading has drifted if told."""
        self._world.push(t_ns, wxyz, heading_sigma_rad)
        if np.isnan(wxyz).any():
            return
        silent_s = 1e-9 * abs(t_ns - self._sample_ns)
        if silent_s > _RESTARTED_S and heading_sigma_rad < self._sample_drift_rad:
            # A drift does not shrink in silence: the IMU counts from a new beginning, in a new world.
            self._state, self._drift_rad = self._state.lost(), heading_sigma_rad
        self._sample_ns, self._sample_drift_rad = t_ns, heading_sigma_rad

    def palm_at(self, t_ns: int) -> Orientation | None:
        """The palm at an instant, rig frame; None: no sample is near, or the heading may be anywhere."""
        both = self.palm_and_bend_at(t_ns)
        return None if both is None else both[0]

    def palm_and_bend_at(self, t_ns: int) -> tuple[Orientation, Float] | None:
        """The same, and the covariance (3, 2) [rad^2] of its turn, in rig axes, with the bend."""
        found = self._world.samples.between(t_ns)
        if found is None:
            return None
        state = self._state.after(self._since_s(t_ns), self._walked_rad2(t_ns, found))
        if state.heading_sigma_rad > _LOST_RAD:
            return None
        rotation, slope = state.palm(self._forearm(found))
        turned = (DEFAULT.palm_walk_rad_s * found.away_s) ** 2 * np.eye(3)
        return Orientation(rotation, slope @ state.cov @ slope.T + turned), slope @ state.with_bend

    def bend_at(self, t_ns: int) -> tuple[Float, Float]:
        """The bend (2,) [rad] at an instant, and its covariance (2, 2)."""
        state = self._state.after(self._since_s(t_ns), 0.0)
        return state.bend_rad, state.bend_cov

    def world_at(self, t_ns: int) -> tuple[Float, Float]:
        """The palm at an instant in the IMU's own world, which needs no heading: as `PalmWorld.at`, but bent."""
        wxyz, sigma = self._world.at(t_ns)
        if isnan(wxyz[0]):
            return NO_WORLD
        bend, cov = self.bend_at(t_ns)
        forearm = quaternion_to_matrix(wxyz)
        axes = forearm @ bend_axes(bend)
        x, y, z = np.vecdot(axes @ cov, axes).tolist()
        tilt, heading = hypot(sigma[0], sqrt(0.5 * (x + y))), hypot(sigma[1], sqrt(z))
        palm = matrix_to_quaternion(forearm @ forearm_palm(bend))
        return palm, np.array([tilt, min(heading, ANYWHERE_RAD)])

    def saw(self, t_ns: int, told: ToldForearm) -> None:
        """Take what markers, and fingers before the device, tell of palm and bend.

        Args:
            t_ns: When; what is older than the last, by less than a second, is late and left out.
            told: That, in the rig.
        """
        found = self._world.samples.between(t_ns)
        if not told.known:
            self.counts["forearm.missing"] += 1
        elif self._t_ns is not None and _CLOCK_NS < t_ns - self._t_ns < 0:
            self.counts["forearm.late"] += 1
        elif found is None:
            self.counts["forearm.alone"] += 1
        else:
            self._take(t_ns, found, SeenForearm.of(told, self._forearm(found)))

    def _take(self, t_ns: int, found: Between, seen: SeenForearm) -> None:
        """Learn from an instant, or leave it out."""
        since_s = self._since_s(t_ns)
        walked_rad2 = self._walked_rad2(t_ns, found)
        state = self._state.after(since_s, walked_rad2)
        palm, cov = seen.told.palm(state.bend_rad, state.bend_cov)
        turned = bool(np.linalg.eigvalsh(cov)[-1] < TELLS_RAD**2)
        contrary = self._contrary_ns
        anew = turned and len(contrary) >= _CONTRARY and abs(t_ns - contrary[0]) > _CONTRARY_NS
        if anew:
            state = state.anew()
        if len(seen.pull) == 0 or (state.heading_sigma_rad > _LOST_RAD and not turned):
            self.counts["forearm.vague"] += 1
            return
        if state.heading_sigma_rad > _LOST_RAD:
            self.counts["forearm.begun"] += 1
            state, self._rival = state.lost().towards(palm, seen.world_forearm), None
        misfit = seen.against(state)
        likely, density = seen.likely(state, misfit)
        if not (likely or anew):
            state = state.flicked(since_s)
            likely, density = seen.likely(state, misfit)
        if not (likely or anew):
            self.counts["forearm.outlier"] += 1
            contrary.append(t_ns)
            return
        self.counts["forearm.seen"] += 1
        contrary.clear()
        rival = None if self._rival is None else self._rival.after(since_s, walked_rad2)
        self._state, self._t_ns, self._drift_rad = state.told(seen, misfit), t_ns, found.drift_rad
        if rival is not None or turned:
            self._challenge(t_ns, rival, palm, seen, density)

    def _challenge(
        self, t_ns: int, rival: ForearmState | None, palm: Float, seen: SeenForearm, density: float
    ) -> None:
        """Let a rival that began lately, with any heading, take over where it foretells the palms far better.

        What a small jump of the heading does looks like a bend at first (generalised likelihood ratio: Willsky, Jones
        1976). While there is none a rival leads by e^n no more often than once in e^n (Ville's inequality).
        """
        if rival is None or self._lead < _BEHIND or abs(t_ns - self._rival_ns) > _RIVAL_NS:
            rival = self._state.anew().towards(palm, seen.world_forearm)
            self._rival, self._rival_ns, self._lead = rival.told(seen, seen.against(rival)), t_ns, 0.0
            return
        misfit = seen.against(rival)
        self._lead += seen.likely(rival, misfit)[1] - density
        self._rival = rival.told(seen, misfit)
        if self._lead > _LEAD:
            self.counts["forearm.begun"] += 1
            self._state, self._rival = self._rival, None

    def _forearm(self, found: Between) -> Float:
        """The forearm (3, 3) in the IMU's world."""
        return quaternion_to_matrix(found.q_wxyz) @ self._imu_forearm

    def _since_s(self, t_ns: int) -> float:
        """How long after the last palm an instant is [s]; without one nothing has begun to move."""
        return 0.0 if self._t_ns is None else 1e-9 * (t_ns - self._t_ns)

    def _walked_rad2(self, t_ns: int, found: Between) -> float:
        """Variance [rad^2] of what the heading has drifted since the last palm.

        Drifts that a filter tells are no walks: mostly a bias that nobody knows, whose variance grows with the square
        of the time. Of a long silence that counts; from palm to palm it is a walk, of as much as can be followed.
        """
        since_s, before_rad = abs(self._since_s(t_ns)), self._drift_rad
        even_rad = abs(found.drift_rad - before_rad)
        walked = found.drift_rad**2 - before_rad**2
        if found.drift_rad >= ANYWHERE_RAD:  # as much as is ever told
            even_rad, walked = max(even_rad, self._even_rad_s * since_s), _MOST2 * since_s
        return max(even_rad**2, min(max(walked, _WALK2 * since_s), _MOST2 * since_s))
