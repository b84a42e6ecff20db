"""Pose of the palm before the camera while the wrist is flexed.

A bent wrist turns the palm in the image, ten degrees aside by nearly the breadth of a finger, so that roots and
search bands of a straight wrist name the neighbour. Whatever the fingers do, up to the webs the skin is whole, beyond
them a gap or a crease parts every two fingers; and along the little finger's side skin ends. Each of some hundred
bends predicts where both are in the LED image, and what is seen there is compared (contrast of the roots of light, so
that neither distance nor power of the LEDs matters):

    E(bend) = gaps beyond the webs - gaps below them + edges at the sides, less (bend / usual bend)^2 / 2

Of a strobe cycle alone, nothing is kept. Where the image does not clearly show that it is bent, the wrist is
straight.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from common.arrays import Bool, Float, Float32, Image, Int
from common.geometry.transforms import rigid
from common.hand.model import CHAINS, METACARPALS
from common.hand.wrist import STRAIGHT, forearm_palm
from slave.wrist.led_image import NEAREST_M, SHRINK, WristView, in_image, shrink

STEP_RAD = float(np.radians(4.0))
_MOST_STEPS = np.array([8, 4])  # of flexion, deviation: 32 and 16 degrees
_TYPICAL_RAD = np.radians((15.0, 8.0))  # standard deviations of the prior
_DARK = np.float32(2.0)  # root of grey levels: noise
_BELOW_M = (-16e-3, -11e-3, -6e-3, -1e-3)  # of that: whole skin
_BEYOND_M = (5.5e-3, 9e-3, 12.5e-3, 16e-3)  # a gap
_METACARPAL, _LITTLE, _INDEX = (
    (0.4, 0.52, 0.64, 0.76, 0.88, 1.0),
    (0.15, 0.35),
    (0.2, 0.4),
)  # along these bones
# A bend is accepted that shows so much of what it should, and is so much more probable than a straight wrist: fists
# have gaps of their own. One that shows less of it must be more probable.
_ACCEPTED = ((0.6, 3.0), (0.45, 5.0))
# So little changes no name, and webs of one hand lie that much beside those of the next.
_NEAR_STRAIGHT_RAD = 1.01 * STEP_RAD * np.array([3.0, 1.0])
_VIEW_STEPS = np.array([4, 1])  # steps between two views that search bands and reach are made for
_MOST_VIEWS = np.array([1, 3])  # on either side of the straight one


@dataclass(frozen=True, slots=True, eq=False)
class PalmPose:
    """How the palm lies now.

    Attributes:
        wrist_angles_rad: (2,) bend of the wrist (`common.hand.wrist`).
        T_camera_palm: (4, 4) with it [m].
        view: One as if the palm lay about like that: what search bands and reach are made of.
    """

    wrist_angles_rad: Float
    T_camera_palm: Float
    view: WristView

    @property
    def straight(self) -> bool:
        """Whether the palm is where a straight wrist has it, as far as is seen."""
        return not self.wrist_angles_rad.any()


@dataclass(frozen=True, slots=True, eq=False)
class _Marks:
    """Marks of the palm in the shrunken image, as flat indices, for B bends."""

    candidates: Float  # (B, 2) [rad]
    prior: Float32  # (B,) what each costs
    near_straight: Bool  # (B,) whether it is hardly one
    gap: Int  # (B, 3, G) pixels of a gap's two sides and its middle
    gap_weight: Float32  # (B, G) below 0 where there is none; 0 outside of the image
    edge: Int  # (B, 2, S) pixels inside of skin and outside
    edge_weight: Float32  # (B, S)


def find_palm_pose(led: Image, view: WristView) -> PalmPose:
    """How the palm lies in the difference of LED and ambient frame (H, W)."""
    wrist_angles = wrist_angles_seen(np.sqrt(shrink(led)), view)
    if not wrist_angles.any():
        return PalmPose(STRAIGHT, view.T_camera_palm, view)
    steps = np.rint(wrist_angles / STEP_RAD / _VIEW_STEPS).clip(-_MOST_VIEWS, _MOST_VIEWS).astype(np.int64)
    return PalmPose(
        wrist_angles,
        rotated_view(view, wrist_angles).T_camera_palm,
        _view(view, int(steps[0]), int(steps[1])),
    )


def prepare(view: WristView) -> list[WristView]:
    """All views that `find_palm_pose` gives, the straight one among them."""
    _marks(view)
    flexion, deviation = (range(-int(most), int(most) + 1) for most in _MOST_VIEWS)
    return [_view(view, a, b) for a in flexion for b in deviation]


def rotated_view(view: WristView, wrist_angles_rad: Float) -> WristView:
    """The view of a palm that a bend (2,) has turned."""
    T = view.T_camera_palm @ rigid(forearm_palm(wrist_angles_rad), np.zeros(3))
    return replace(view, T_camera_palm=T)


@lru_cache(maxsize=256)
def _view(view: WristView, flexion: int, deviation: int) -> WristView:
    if not flexion and not deviation:
        return view
    return rotated_view(view, STEP_RAD * _VIEW_STEPS * np.array([flexion, deviation]))


def wrist_angles_seen(near: Float32, view: WristView) -> Float:
    """Estimate the bend (2,) [rad] from roots of grey levels (h, w); 0: none plain."""
    marks = _marks(view)
    shown = _shown(near.ravel(), marks)
    evidence = 14.0  # logarithm of probability per unit of E
    score = np.float32(evidence) * shown - marks.prior
    best = int(score.argmax())
    more = float(score[best] - score[marks.near_straight].max())
    if not any(shown[best] >= least and more >= least_more for least, least_more in _ACCEPTED):
        return STRAIGHT
    about = (np.abs(marks.candidates - marks.candidates[best]) < 1.5 * STEP_RAD).all(axis=1)
    weight = np.exp(score[about] - score[best])
    wrist_angles: Float = weight @ marks.candidates[about] / weight.sum()
    return STRAIGHT if marks.near_straight[best] else wrist_angles


def _shown(near: Float32, marks: _Marks) -> Float32:
    """How much (B,) of what each bend would show is seen in roots of grey levels."""
    low, high, middle = (near[marks.gap[:, k]] for k in range(3))
    sides = np.minimum(low, high)
    gaps = (sides - middle) / (sides + middle + _DARK)
    top = 0.4  # contrast that an open gap exceeds: a deeper one adds no evidence
    gaps = np.where(marks.gap_weight < 0.0, np.abs(gaps), gaps).clip(0.0, top)
    inside, outside = near[marks.edge[:, 0]], near[marks.edge[:, 1]]
    edges = ((inside - outside) / (inside + outside + _DARK)).clip(0.0, top)
    out: Float32 = (gaps * marks.gap_weight).sum(axis=1) + (edges * marks.edge_weight).sum(axis=1)
    return out


@lru_cache(maxsize=8)
def _marks(view: WristView) -> _Marks:
    flexion, deviation = (np.arange(-most, most + 1, dtype=np.float64) for most in _MOST_STEPS.tolist())
    steps: Float = np.stack(np.meshgrid(flexion, deviation, indexing="ij"), axis=-1)
    candidates: Float = STEP_RAD * steps.reshape(-1, 2)
    hardly: Bool = np.abs(candidates / _NEAR_STRAIGHT_RAD).max(axis=1) <= 1.0
    gap, gap_weight = _gaps(view)
    edge, edge_weight = _edges(view)
    views = [rotated_view(view, wrist_angles) for wrist_angles in candidates]
    at, inside = zip(*(_pixels(one, gap) for one in views), strict=True)
    sides, shows = zip(*(_pixels(one, edge) for one in views), strict=True)
    return _Marks(
        candidates,
        (0.5 * ((candidates / _TYPICAL_RAD) ** 2).sum(axis=1)).astype(np.float32),
        hardly,
        np.array(at),
        (gap_weight * np.array(inside)).astype(np.float32),
        np.array(sides),
        (edge_weight * np.array(shows)).astype(np.float32),
    )


def _pixels(view: WristView, points: Float) -> tuple[Int, Float]:
    """Flat pixels (K, N) of palm points (K, N, 3) [m]; whether (N,) all K are seen."""
    size = np.array([view.optics.width_px, view.optics.height_px]) // SHRINK
    uv, depth = in_image(view, points)
    seen = (depth > NEAREST_M) & np.isfinite(uv).all(axis=-1)
    cell = np.floor(np.where(seen[..., None], uv, -1.0) / SHRINK)
    inside = seen & (cell >= 0.0).all(axis=-1) & (cell < size).all(axis=-1)
    column, row = np.moveaxis(cell.clip(0.0, size - 1.0).astype(np.int64), -1, 0)
    shows: Float = np.asarray(inside.all(axis=0), dtype=np.float64)
    at: Int = row * int(size[0]) + column
    return at, shows


def _gaps(view: WristView) -> tuple[Float, Float]:
    """Both sides and middle (3, G, 3) of gaps [m], palm frame, and weights (G,)."""
    knuckles, ends = (view.model.rest_position_m[CHAINS[1:, k]] for k in (0, 1))
    bone = ends - knuckles
    along = bone / np.linalg.norm(bone, axis=1, keepdims=True)
    beyond = np.array(_BELOW_M + _BEYOND_M)
    points: list[Float] = []
    for k in range(3):
        root, way = (knuckles[k] + knuckles[k + 1]) / 2.0, (bone[k] + bone[k + 1]) / 2.0
        web = 0.4  # of the proximal phalanx: where the webs end (`search_bands`)
        middle = root + (web + beyond[:, None] / np.linalg.norm(way)) * way
        sides = [knuckles[f] + ((middle - knuckles[f]) @ along[f])[:, None] * along[f] for f in (k, k + 1)]
        points.append(np.stack([*sides, middle]))
    weight = np.where(beyond < 0.0, -1.0 / len(_BELOW_M), 1.0 / len(_BEYOND_M))
    return np.concatenate(points, axis=1), np.tile(weight, 3)


def _edges(view: WristView) -> tuple[Float, Float]:
    """Inside and outside (2, S, 3) of the palm's sides [m], and weights (S,)."""
    rest, radius = view.model.rest_position_m, view.model.radius_m
    index, little = CHAINS[1], CHAINS[4]
    out = np.array([np.sign(rest[little[0], 0] - rest[index[0], 0]), 0.0, 0.0])
    sides = (
        (METACARPALS[3], little[0], little[0], _METACARPAL, out),
        (little[0], little[1], little[0], _LITTLE, out),
        (index[0], index[1], index[0], _INDEX, -out),
    )  # as thick at the end as at the third
    points: list[Float] = []
    for start, end, thick_as, shares, way in sides:
        share = np.array(shares)[:, None]
        axis = rest[start] + share * (rest[end] - rest[start])
        thick = radius[start] + share * (radius[thick_as] - radius[start])
        inside_m, outside_m = 3.5e-3, 5e-3  # of the skin's edge
        points.append(np.stack([axis + (thick + off) * way for off in (-inside_m, outside_m)]))
    few = len(_LITTLE) + len(_INDEX)
    edge_weight = 0.125
    weight = np.concatenate([np.full(len(_METACARPAL), 1.0 / len(_METACARPAL)), np.full(few, edge_weight)])
    return np.concatenate(points, axis=1), weight
