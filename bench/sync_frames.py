"""An open hand that swings at 1 m/s, rendered for cameras that nobody synchronised, through the whole line."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np

from bench.played import START_NS, Watched, solve, watch
from bench.sync_rig import SPEED_M_S, Treatment
from common.arrays import Float
from common.calibration import HandProfile, load
from common.geometry.camera_model import CameraModel
from common.sim.motion import REST, HandState, angles_of, base_pose
from common.sim.scene import Scene, view_centre
from master.rig.files import load_setup
from master.rig.setup import RigSetup

CALIBRATION = Path(__file__).resolve().parents[1] / "calib_json"
AMPLITUDE_M = 0.15
SECONDS = 0.9
_WARM_S = 0.25  # until the detector has tracks


@dataclass(frozen=True, slots=True, eq=False)
class Swing:
    """The resting posture moved along x; the speed at the middle is SPEED_M_S."""

    setup: RigSetup

    @property
    def period_s(self) -> float:
        """Of the swing [s]."""
        return 2.0 * np.pi * AMPLITUDE_M / SPEED_M_S

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]."""
        shift = np.array([AMPLITUDE_M * np.sin(SPEED_M_S / AMPLITUDE_M * t_s), 0.0, 0.0])
        posture = np.array(REST, dtype=np.float64)
        T = base_pose(self.setup.hand, view_centre(self.setup.rig), shift, np.zeros(3))
        return HandState(T, angles_of(self.setup.hand, posture, np.zeros((5, 4))))


@cache
def _scene(rate_hz: float) -> tuple[RigSetup, Scene]:
    setup = load_setup(CALIBRATION, "desk")
    cameras = {n: msgspec.structs.replace(c, frame_rate_hz=rate_hz) for n, c in setup.cameras.items()}
    profile = load(CALIBRATION / "hands" / f"{setup.rig.hand}.json", HandProfile)
    return replace(setup, cameras=cameras), Scene.of_motion(setup.rig, cameras, profile, Swing(setup))


@cache
def _monitored(rate_hz: float, offset_s: float) -> tuple[Watched, ...]:
    setup, scene = _scene(rate_hz)
    times = np.arange(round(SECONDS * rate_hz)) / rate_hz
    return tuple(watch(scene, name, times + c * offset_s) for c, name in enumerate(setup.rig.cameras))


def rendered(rate_hz: float, offset_s: float, treatment: Treatment) -> Float:
    """Errors of depth [%] of all caps at all instants, before the filter."""
    setup, scene = _scene(rate_hz)
    watched = _monitored(rate_hz, offset_s)
    if treatment == "predict":
        setup = replace(setup, rig=msgspec.structs.replace(setup.rig, frame_sync="predict"))
    if treatment == "uncorrected":
        watched = tuple(_by_number(one, rate_hz) for one in watched)
        models: dict[str, CameraModel] = {n: replace(m, row_time_ns=0.0) for n, m in setup.models.items()}
        setup = replace(setup, models=models)
    errors: list[Float] = []
    for pose in solve(setup, watched)[0]:
        t_s = (pose.t_ns - START_NS) * 1e-9
        if t_s > _WARM_S:
            truth = scene.truth(t_s).markers_m[:, 2]
            error = 100.0 * (pose.markers_raw_m[:, 2] - truth) / truth
            errors.append(error[np.isfinite(error)])
    return np.concatenate(errors)


def _by_number(watched: Watched, rate_hz: float) -> Watched:
    """The k-th frame with the k-th of the other cameras."""
    messages = tuple(
        msgspec.structs.replace(m, t_ns=START_NS + round(m.seq * 1e9 / rate_hz)) for m in watched.messages
    )
    return replace(watched, messages=messages)
