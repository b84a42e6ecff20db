"""What the sensors would report of a scene, of its exact truth and errors as large as measured; nothing is drawn.

For tuning an estimator on many seeds. Errors wander, as real ones do: a detector that is wrong is wrong for a while.

| report | made of | errors |
|---|---|---|
| marker | centroid of its visible paint | found from 15 px^2 on; 0.06 px of a whole cap to 0.6 px of a speck |
| laser, four fingers | centroid of the line in sight | 0.55 px; 3 % of the time that of a neighbour |
| laser, thumb | the same | 3.3 px; 30 % of the time 12 px |
| fingertip | its end, where in sight | 2.5 px; a quarter missed; 5 % some 20 px elsewhere; of thumbs one in six |

They are those of 30 s of the six poses, rendered and detected (`slave.markers`, `slave.wrist`), and of docs/wrist.md.
"""

from statistics import NormalDist

import numpy as np

from bench.both.scene import Both, Observed, Shown, Sight, in_order, orientations
from bench.played import START_NS, times_of
from common.arrays import Bool, Float
from common.messages import MarkerDetections, WristDetections
from common.sim.painter import MarkerView
from common.sim.render import Renderer
from common.sim.scene import Scene
from common.sim.wrist.scene import WristTruth

_HOLD_S = 0.2  # errors and misses are about the same for so long
_SPOT_PX2, _SPOT_SPREAD_PX2 = 15.5, 4.0  # of paint that is found half of the time
_WHOLE_PX2, _WHOLE_PX, _SPECK_PX = 100.0, 0.1, 1.1  # claimed of caps from so much paint on, and at most
_OF_CLAIMED = 0.6  # how large errors are by what is claimed
_LASER_PX, _LASER_CLAIMED_PX, _LINE_SHARE = 0.55, 0.5, 0.63  # of the line's length is reported
_LINE_M = 3e-3
_THUMB_PX, _THUMB_WRONG_PX, _THUMB_CLAIMED_PX = 3.3, 12.0, (12.0, 29.0)
_TIP_PX, _TIP_CLAIMED_PX, _TIP_FALSE_PX, _TIP_FALSE_CLAIMED_PX = 2.5, 4.4, 20.0, 9.0
_DEPTH_UNIT, _DEPTH_NOISE = 0.8, 0.04
_OTHER_FINGER, _THUMB_WRONG, _TIP_FOUND, _THUMB_TIP_FOUND, _TIP_FALSE = (
    NormalDist().inv_cdf(share) for share in (0.03, 0.3, 0.75, 0.15, 0.05)
)


class _Wander:
    """Errors of unit variance that are about the same for a while (an AR(1) process), N at once."""

    def __init__(self, rng: np.random.Generator, shape: tuple[int, ...], step_s: float) -> None:
        self._rng, self._keep = rng, float(np.exp(-step_s / _HOLD_S))
        self._now = rng.normal(size=shape)

    def __call__(self) -> Float:
        """The next step."""
        fresh = self._rng.normal(size=self._now.shape)
        self._now = self._keep * self._now + np.sqrt(1.0 - self._keep**2) * fresh
        return self._now


def shown(name: str, seconds: float, seed: int, every: int = 1) -> Shown:
    """What the sensors report of the scene called `name` within its first `seconds`.

    Args:
        name: One of `fusion_scene.SCENES`, or another that both kinds of rig can show.
        seconds: How long.
        seed: Of motion and errors.
        every: Only each so many-th frame of the marker cameras, to save time.

    Raises:
        PhalanxError: No such scene.
    """
    return shown_of(Both.of(name, seed), seconds, every)


def shown_of(both: Both, seconds: float, every: int = 1) -> Shown:
    """The same of a scene before other rigs."""
    messages = orientations(both, seconds)
    times, marker_colour = dict[str, Float](), dict[str, Float]()
    for camera in both.markers.rig.cameras:
        rate = both.markers.cameras[camera].frame_rate_hz / every
        times[camera] = times_of(both.scene, camera, seconds, rate)
        found, marker_colour[camera] = markers_shown(both.scene, camera, times[camera], 1.0 / rate, both.seed)
        messages += found
    frame_s = 1.0 / both.wrist.cameras[both.wrist.rig.cameras[0]].frame_rate_hz
    line_t = np.arange(1.0, seconds / frame_s - 1.0, 3.0) * frame_s
    cycles, line, tip = _cycles(both, line_t, frame_s)
    return Shown(both, seconds, in_order(messages + cycles), Sight(times, marker_colour, line_t, line, tip))


def markers_shown(
    scene: Scene, camera: str, times_s: Float, step_s: float, seed: int
) -> tuple[list[MarkerDetections], Float]:
    """One marker camera's frames at scene times (T,) [s], and the paint (T, M) [px^2] in sight."""
    place = scene.rig.cameras.index(camera)
    count = len(scene.rig.markers)
    rng = np.random.default_rng([seed, 21, place])
    least, lasting = _Wander(rng, (count,), step_s), _Wander(rng, (count, 2), step_s)
    renderer = Renderer(scene, camera)
    out: list[MarkerDetections] = []
    marker_colour: list[Float] = []
    for seq, t in enumerate(times_s.tolist()):
        view = renderer.markers(t)
        marker_colour.append(np.where(np.isfinite(view.uv[:, 0]), view.area, 0.0))
        off = 0.8 * lasting() + 0.6 * rng.normal(size=(count, 2))
        found = view.area > _SPOT_PX2 + _SPOT_SPREAD_PX2 * least()
        out.append(_marker_message(camera, seq, START_NS + round(t * 1e9), view, found, off))
    return out, np.array(marker_colour)


def _marker_message(
    camera: str, seq: int, t_ns: int, view: MarkerView, found: Bool, off: Float
) -> MarkerDetections:
    """One frame, of which these markers (M,) are found, with errors of unit variance (M, 2)."""
    found = found & np.isfinite(view.uv[:, 0])
    small = (_WHOLE_PX2 / np.maximum(view.area, 1.0)) ** 1.4
    sigma = np.clip(_WHOLE_PX * small, _WHOLE_PX, _SPECK_PX)
    return MarkerDetections(
        camera=camera,
        session=1,
        seq=seq,
        t_ns=t_ns,
        ready_t_ns=t_ns,
        uv=np.where(found[:, None], view.uv + (_OF_CLAIMED * sigma)[:, None] * off, np.nan),
        area=np.where(found, view.area, np.nan),
        quality=np.where(found, np.clip(view.area / _WHOLE_PX2, 0.1, 1.0), np.nan),
        sigma_px=np.where(found, sigma, np.nan),
        alt_uv=np.full((len(found), 2), np.nan),
    )


def _cycles(both: Both, times_s: Float, frame_s: float) -> tuple[list[Observed], Float, Bool]:
    """The triples with laser frames at these times, and of line [m] and tips (K, 5) what is in sight."""
    report = _WristErrors(both, 3.0 * frame_s)
    out: list[Observed] = []
    lines: list[Float] = []
    tips: list[Bool] = []
    for k, t in enumerate(times_s.tolist()):
        laser, led = both.wrist_scene.truth(t), both.wrist_scene.truth(t + frame_s)
        lines.append(laser.laser_len_vis[1:6])
        tips.append(led.tip_visible)
        t_ns = START_NS + round(t * 1e9)
        out.append(report(3 * k + 1, t_ns, t_ns + round(frame_s * 1e9), laser, led))
    return out, np.array(lines), np.array(tips)


class _WristErrors:
    """Makes messages of truth. Holds the errors of the moment."""

    def __init__(self, both: Both, step_s: float) -> None:
        rng = np.random.default_rng([both.seed, 22])
        self._camera, self._fx = both.wrist.rig.cameras[0], float(both.wrist_scene.optics.matrix[0, 0])
        self._rng = rng
        self._other, self._missed, self._false = (_Wander(rng, (5,), step_s) for _ in range(3))
        self._laser, self._tip, self._aside = (_Wander(rng, (5, 2), step_s) for _ in range(3))

    def __call__(
        self, seq: int, t_ns: int, ready_ns: int, laser: WristTruth, led: WristTruth
    ) -> WristDetections:
        """The message of one triple, from the truth at its laser and at its LED frame."""
        at, sigma, length = self._line(laser)
        tip, tip_sigma = self._tips(led)
        depth = _DEPTH_UNIT * led.tip_xyz[:, 2] * (1.0 + _DEPTH_NOISE * self._rng.normal(size=5))
        return WristDetections(
            camera=self._camera,
            session=1,
            seq=seq,
            t_ns=t_ns,
            ready_t_ns=ready_ns,
            laser_uv=at,
            laser_sigma_px=sigma,
            laser_px=length,
            tip_uv=tip,
            tip_sigma_px=tip_sigma,
            tip_depth=np.where(np.isnan(tip[:, 0]), np.nan, depth),
        )

    def _line(self, truth: WristTruth) -> tuple[Float, Float, Float]:
        other, off = self._other(), 0.8 * self._laser() + 0.6 * self._rng.normal(size=(5, 2))
        line, length_m = truth.laser_uv[1:6], truth.laser_len_vis[1:6]
        seen = (length_m >= _LINE_M) & np.isfinite(line[:, 0])
        at = line + _LASER_PX * off
        sigma = np.full(5, _LASER_CLAIMED_PX)
        for f in np.flatnonzero(other < _OTHER_FINGER):
            near = [n for n in (f - 1, f + 1) if f > 0 and 0 < n < 5 and seen[n]]
            if near:
                at[f] = line[near[0]] + _LASER_PX * off[f]
        wrong = bool(other[0] < _THUMB_WRONG)
        at[0] = line[0] + (_THUMB_WRONG_PX if wrong else _THUMB_PX) * off[0]
        sigma[0] = _THUMB_CLAIMED_PX[int(wrong)]
        length = _LINE_SHARE * self._fx * length_m / truth.laser_xyz[1:6, 2]
        nothing = np.where(seen, 1.0, np.nan)
        return at * nothing[:, None], sigma * nothing, length * nothing

    def _tips(self, truth: WristTruth) -> tuple[Float, Float]:
        missed, false = self._missed(), self._false() < _TIP_FALSE
        off, aside = 0.8 * self._tip() + 0.6 * self._rng.normal(size=(5, 2)), self._aside()
        typical = np.array([_THUMB_TIP_FOUND, *4 * [_TIP_FOUND]])
        found = truth.tip_visible & (missed < typical) & np.isfinite(truth.tip_uv[:, 0])
        away = _TIP_FALSE_PX * aside / np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 0.5)
        at = truth.tip_uv + np.where(false[:, None], away, 0.0) + _TIP_PX * off
        claimed = np.where(false, _TIP_FALSE_CLAIMED_PX, _TIP_CLAIMED_PX)
        return np.where(found[:, None], at, np.nan), np.where(found, claimed, np.nan)
