"""A view is the scene in front of one camera, with what occludes what.

Rolling shutter: the middle of the exposure of row v is `t + v row_time`, so a part's place and its row are found
together, by two rounds of projecting and moving (the hand moves far less than a row per row time). Between three
exact times the key points follow a parabola.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import cross, invert, transform
from common.sim import raster
from common.sim.light import LAYER_COSINES, TO_LIGHT_RIG
from common.sim.motion import Cylinder, HandState
from common.sim.objects_seen import (
    Appearances,
    Points,
    SeenObjects,
    SeenPart,
    depth_along,
    ends_of,
    project_all,
)
from common.sim.raster import Int32, Shape
from common.sim.scene import Scene
from common.sim.surface import (
    CAPSULES,
    CENTROID_AHEAD,
    CYLINDER_SHARE,
    LAYER_SINES,
    PALM_HULL,
    SLEEVE_SPHERES,
    SPHERE_COUNT,
    WEB_HULL,
    HandSurface,
    cap_outline,
    rim,
    tube_rims,
    unit,
    unit_circle,
)
from common.sim.tracked import ObjectSurface

NEAREST_M = 0.05
INTO_COSINE = np.sqrt(0.5)  # to the sleeve's axis: from there on its opening is seen rather than its side
LAYERS = len(LAYER_COSINES)
PHALANGES = len(CAPSULES)
_PALM, _WEB, _CUFF, _ELBOW = list(PALM_HULL), list(WEB_HULL), *SLEEVE_SPHERES


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Geometry of one frame, with every part at the moment of its row.

    C caps in the order of `HandSurface.caps`.

    Attributes:
        points: (K, 3) key points [m], camera frame.
        uv: (K, 2) [px] of the points; speed_uv: (K, 2) [px/s].
        t_s: (K,) the moments [s], scene time.
        discs_uv: (B, LAYERS, 2) [px], discs_px: (B, LAYERS): shading of the spheres, then of the caps' two ends each.
        outlines: (PHALANGES, LAYERS, N, 2) [px] phalanges.
        cap_uv: (C, N, 2) [px] points whose hull is the cap's outline.
        rim_uv: (C, n, 2) [px] the cap's edge towards the finger, and the finger's girth at its last joint.
        from_behind: (C,) the finger points away from the camera, so that its own skin hides part of the cap.
        bands: (C, LAYERS, N, 2) shading of the caps from their second layer on, then the spot where the
            marker mirrors the lamp, in OpenCV's numbers (`raster.fixed`).
        cuff_uv: (LAYERS, n, 2) [px] front edge of the sleeve.
        palm_speed: (2,) [px/s] of the palm.
        palm, web, sleeve: Hulls (N, 2) [px] of each layer, the first the outline.
        into_sleeve: The camera looks into the sleeve rather than at its side: the hand then lies before it.
        things: What the hand takes, before it is drawn or hides anything.
        tracked: The tracked objects, likewise.
    """

    points: Float
    uv: Float
    speed_uv: Float
    t_s: Float
    discs_uv: Float
    discs_px: Float
    outlines: Float
    cap_uv: Float
    rim_uv: Float
    from_behind: Bool
    bands: Int32
    cuff_uv: Float
    palm_speed: Float
    palm: tuple[Float, ...]
    web: tuple[Float, ...]
    sleeve: tuple[Float, ...]
    into_sleeve: bool
    things: tuple[SeenPart, ...]
    tracked: SeenObjects


class View:
    """Projection of one scene into one camera; every call is pure."""

    def __init__(self, scene: Scene, camera: str) -> None:
        """Prepare; CalibrationError: no such camera, or a marker cannot be painted."""
        if camera not in scene.optics:
            raise CalibrationError(f"camera {camera!r}: the scene has only {', '.join(scene.optics)}")
        self.scene = scene
        self.optics: CameraModel = scene.optics[camera]
        self.surface = HandSurface.of(scene.model, scene.rig.markers, scene.rig.free_markers)
        self.row_s = self.optics.row_time_ns * 1e-9
        self.exposure_s = scene.cameras[camera].exposure_us * 1e-6
        self.T_camera_rig = invert(self.optics.T_rig_camera)
        self.to_light = self.T_camera_rig[:3, :3] @ TO_LIGHT_RIG
        self.focal_px = float(np.sqrt(self.optics.matrix[0, 0] * self.optics.matrix[1, 1]))
        self.circle = unit_circle(16)
        caps = self.surface.caps
        self.cap_radius = np.array([cap.radius_m for cap in caps])
        self.cap_centre = np.array([cap.centre for cap in caps], dtype=np.intp)
        self.cap_base = np.array([cap.base for cap in caps], dtype=np.intp)
        self._cap_joint = np.array([4 * cap.finger + 2 for cap in caps], dtype=np.intp)
        ends = np.stack([self.cap_centre, self.cap_base], axis=1).ravel()
        self._bodies = np.concatenate([np.arange(SPHERE_COUNT), ends])
        self._radius = np.concatenate([self.surface.radius_m, np.repeat(self.cap_radius, 2)])
        first = SPHERE_COUNT + 2 * np.arange(len(caps))
        self._from = np.concatenate([CAPSULES[:, 0], first])
        self._to = np.concatenate([CAPSULES[:, 1], first + 1])
        self._to_lit = (self._radius[:, None] * LAYER_COSINES)[..., None] * self.to_light
        self._fine_circle = unit_circle(32)
        self.objects = ObjectSurface.of(scene.tracked, scene.rig.markers)
        self._appearances = Appearances(self.to_light, self.circle, self.focal_px, self.project)
        count = len(self.surface.weights) + len(self.objects.local)
        # Points of one marker share the moment of the marker's centroid: row k weighs the rows for point k.
        together = np.eye(count)
        for box in self.surface.boxes:
            together[box.corners, box.corners] = 1.0 / 8.0
        ahead = CENTROID_AHEAD / CYLINDER_SHARE
        for cap in caps:
            together[[cap.centre, cap.base], cap.centre] = 1.0 + ahead
            together[[cap.centre, cap.base], cap.base] = -ahead
        self._together = together

    def exposed(self, exposure_us: float) -> "View":
        """The same view with another exposure [us]."""
        other = copy(self)
        other.exposure_s = exposure_us * 1e-6
        return other

    def project(self, points: Float) -> Float:
        """Pixels (..., 2) of points (..., 3) [m], camera frame, clamped far outside."""
        uv = self.optics.distort(points[..., :2] / np.maximum(points[..., 2:], NEAREST_M))
        furthest_px = 4000.0
        return np.minimum(np.maximum(uv, -furthest_px), furthest_px)

    def snapshot(self, t_s: float) -> Snapshot:
        """Geometry of the frame whose row 0 is exposed around `t_s` [s]."""
        points, uv, speed_uv, when, things = self._moments(t_s)
        body = points[self._bodies]
        lit = body[:, None] + self._to_lit
        size = self.focal_px * self._radius / np.maximum(body[:, 2], NEAREST_M)
        discs_px = size[:, None] * LAYER_SINES
        centre, base, (cuff, elbow) = points[self.cap_centre], points[self.cap_base], points[[_CUFF, _ELBOW]]
        axis, joint = unit(centre - base), points[self._cap_joint]
        half = unit(self.to_light - unit(centre))
        parts = (
            lit,
            cap_outline(centre, base, self.cap_radius, self._fine_circle),
            joint[:, None] + rim(axis, self.surface.radius_m[self._cap_joint], self.circle),
            centre + self.cap_radius[:, None] * half,
            tube_rims(cuff, unit(cuff - elbow), self.surface.radius_m[_CUFF], self.to_light, self.circle),
        )
        discs_uv, cap_uv, joint_uv, shine_uv, cuff_uv = project_all(self.project, parts)
        a, b, own = self._from, self._to, slice(len(self.surface.weights), None)
        outlines = raster.capsules(discs_uv[a], discs_px[a], discs_uv[b], discs_px[b])
        shine_share = 0.17  # radius of the glossy spot, share of the cap's
        spots = raster.discs(shine_uv, shine_share * discs_px[SPHERE_COUNT::2, 0], self.circle)
        bands = np.concatenate([outlines[PHALANGES:, 1:], spots[:, None]], axis=1)
        discs = raster.discs(discs_uv, discs_px, self.circle)
        sleeve = np.concatenate([cuff_uv, discs[_ELBOW]], axis=1)
        return Snapshot(
            points=points,
            uv=uv,
            speed_uv=speed_uv,
            t_s=when,
            discs_uv=discs_uv,
            discs_px=discs_px,
            outlines=outlines[:PHALANGES],
            cap_uv=cap_uv,
            rim_uv=np.concatenate([cap_uv[:, len(self._fine_circle) :], joint_uv], axis=1),
            from_behind=((centre - base) * base).sum(axis=1) > 0.0,
            bands=raster.fixed(bands),
            cuff_uv=cuff_uv,
            palm_speed=speed_uv[_PALM].sum(axis=0) / len(_PALM),
            palm=_hulls(discs[_PALM]),
            web=_hulls(discs[_WEB]),
            sleeve=tuple(raster.hull(layer) for layer in sleeve),
            into_sleeve=_looks_into(cuff, elbow),
            things=self._things(t_s, things),
            tracked=self._appearances.objects(
                self.objects, Points(points[own], uv[own], speed_uv[own], when[own])
            ),
        )

    def own_finger(self, snapshot: Snapshot, cap: int) -> Shape | None:
        """Outline of the last phalanx where it lies before its own cap; None elsewhere."""
        if not snapshot.from_behind[cap]:
            return None
        return Shape(raster.hull(snapshot.rim_uv[cap]), snapshot.speed_uv[self.cap_base[cap]])

    def behind_palm(self, snapshot: Snapshot, points: Float) -> Bool:
        """Whether the palm's plane passes before points (..., 3) [m], camera frame."""
        normal, offset = _palm_plane(snapshot)
        # The plane meets the ray at (offset / (normal . p)) p: before p if that factor is between 0 and 1.
        along = points @ normal
        return np.asarray((along * offset > 0.0) & (np.abs(along) > abs(offset)))

    def shows_back(self, snapshot: Snapshot) -> bool:
        """Whether the back of the hand is turned to the camera."""
        return _palm_plane(snapshot)[1] * self.scene.model.side_sign > 0.0

    def cards(self, snapshot: Snapshot) -> tuple[Shape, ...]:
        """Outlines of the cards near the view, at the moment of the hand's middle row."""
        when = float(snapshot.t_s[: len(PALM_HULL)].mean())
        shapes: list[Shape] = []
        for now, later in zip(self.scene.occluders(when), self.scene.occluders(when + 1e-3), strict=False):
            uv, ahead = (self.project(transform(self.T_camera_rig, quad)) for quad in (now, later))
            shapes.append(Shape(uv, (ahead - uv).mean(axis=0) * 1e3))
        return tuple(shapes)

    def _moments(self, t_s: float) -> tuple[Float, Float, Float, Float, tuple[Cylinder, ...]]:
        """Key points (K, 3), pixels, speeds (K, 2), own moments (K,), things halfway."""
        readout_s = self.optics.height_px * self.row_s
        t_middle = t_s + 0.5 * readout_s
        h = max(0.5 * readout_s, 0.5 * self.exposure_s, 1e-4)
        states = tuple(self.scene.motion.at(t) for t in (t_middle - h, t_middle, t_middle + h))
        before, now, after = transform(self.T_camera_rig, self._key_points(states))
        velocity, curvature = (after - before) / (2.0 * h), (after - 2.0 * now + before) / (h * h)
        when = np.full(len(now), t_middle)
        points = now
        for _ in range(2):
            when = t_s + (self._together @ self.project(points)[:, 1]) * self.row_s
            ahead = (when - t_middle)[:, None]
            points = now + ahead * velocity + 0.5 * ahead * ahead * curvature
        speed = velocity + (when - t_middle)[:, None] * curvature
        z = np.maximum(points[:, 2:], NEAREST_M)
        speed_uv = self.focal_px * (speed[:, :2] / z - points[:, :2] * speed[:, 2:] / z**2)
        return points, self.project(points), speed_uv, when, self.scene.untracked(states[1])

    def _key_points(self, states: tuple[HandState, ...]) -> Float:
        """Key points (S, K, 3) [m], rig frame, of the hand, then of the tracked objects."""
        chains = self.scene.model.chains(np.array([state.angles_rad for state in states]))
        hand = self.surface.key_points(np.array([state.T_rig_palm for state in states]), chains)
        if not self.objects.local.size:
            return hand
        poses = np.array([self.scene.object_poses(state) for state in states])
        return np.concatenate([hand, self.objects.key_points(poses)], axis=1)

    def _things(self, t_s: float, things: tuple[Cylinder, ...]) -> tuple[SeenPart, ...]:
        """Each of `things` halfway, at the moment of the row of its centre."""
        views: list[SeenPart] = []
        for k, thing in enumerate(things):
            middle = transform(self.T_camera_rig, thing.T_rig_object[:3, 3])
            when = t_s + float(self.project(middle)[1]) * self.row_s
            states = (self.scene.motion.at(t) for t in (when, when + 1e-3))
            now, later = (ends_of(self.scene.untracked(state)[k], self.T_camera_rig) for state in states)
            views.append(self._appearances.thing(now, later, 1e-3, thing.radius_m))
        return tuple(views)


def _hulls(discs: Float) -> tuple[Float, ...]:
    """Hulls (N, 2) [px] of the discs (B, LAYERS, n, 2) of each layer."""
    return tuple(raster.hull(layer) for layer in discs.swapaxes(0, 1).reshape(LAYERS, -1, 2))


def _looks_into(cuff: Float, end: Float) -> bool:
    """Whether a camera sees into a sleeve `cuff` - `end` (3,) [m], camera frame."""
    along = end - cuff
    return float(along @ cuff) > INTO_COSINE * float(np.linalg.norm(along) * np.linalg.norm(cuff))


def _palm_plane(snapshot: Snapshot) -> tuple[Float, float]:
    """Normal (3,) and offset, camera frame, of wrist, index and little knuckle."""
    wrist, index, little = snapshot.points[20], snapshot.points[4], snapshot.points[16]
    normal = cross(index - wrist, little - wrist)
    return normal, float(normal @ wrist)


REACH_PX = 8.0  # room for motion during the exposure
NO_PHALANX = -1


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where N markers are in one image.

    Attributes:
        uv: (N, 2) [px] their middles.
        depth: (N,) [m].
        low, high: (N, 2) [px] boxes about their outlines, with room for motion.
        behind_palm: (N,) the palm lies before it, if anywhere.
        phalanx: (N,) which it sits on, so that this one does not hide it, or NO_PHALANX.
    """

    uv: Float
    depth: Float
    low: Float
    high: Float
    behind_palm: Bool
    phalanx: Int

    @classmethod
    def of(
        cls, uv: Sequence[Float], depth: Float, outlines: Sequence[Float], behind_palm: Bool, phalanx: Int
    ) -> "Places":
        """Of markers with outlines (n, 2) [px]."""
        low, high = (np.array([f(one, axis=0) for one in outlines]).reshape(-1, 2) for f in (np.min, np.max))
        middles = np.array(uv).reshape(-1, 2)
        return cls(middles, depth, low - REACH_PX, high + REACH_PX, behind_palm, phalanx)


def outlines_of(snapshot: Snapshot) -> list[Shape]:
    """Outlines of all of a hand: phalanges, caps, palm and sleeve."""
    speed = 0.5 * snapshot.speed_uv[CAPSULES].sum(axis=1)
    solid = [*zip(snapshot.outlines[:, 0], speed, strict=True)]
    solid += [(raster.hull(uv), snapshot.palm_speed) for uv in snapshot.cap_uv]
    solid += [(one[0], snapshot.palm_speed) for one in (snapshot.palm, snapshot.web, snapshot.sleeve)]
    return [Shape(corners, way) for corners, way in solid]


def hand_before(snapshot: Snapshot, places: Places) -> list[list[Shape]]:
    """Outlines of phalanges, sleeve and palm that may occlude each marker."""
    speed = 0.5 * snapshot.speed_uv[CAPSULES].sum(axis=1)
    sleeve = Shape(snapshot.sleeve[0], snapshot.speed_uv[SLEEVE_SPHERES[0]])
    palm = Shape(snapshot.palm[0], snapshot.palm_speed)
    return [
        [
            *(Shape(snapshot.outlines[k, 0], speed[k]) for k in np.flatnonzero(phalanges)),
            *([sleeve] if covered else []),
            *([palm] if behind else []),
        ]
        for phalanges, covered, behind in zip(
            _phalanges_before(snapshot, places),
            _sleeve_before(snapshot, places).tolist(),
            places.behind_palm.tolist(),
            strict=True,
        )
    ]


def things_before(
    snapshot: Snapshot, places: Places, depth_m: Float, but: Sequence[SeenPart | None] = ()
) -> list[list[Shape]]:
    """Outlines of things and parts nearer than depths (N,) [m] before each marker.

    `but`: of each marker the part that it is on.
    """
    things = len(snapshot.things)
    solid = (*snapshot.things, *snapshot.tracked.solid)
    if not solid:
        return [[] for _ in depth_m]
    (start_uv, stop_uv), (start_m, stop_m) = (
        np.moveaxis(np.array(ends), 1, 0)
        for ends in ([part.ends_uv for part in solid], [part.ends_depth for part in solid])
    )
    before = depth_along(places.uv[:, None], start_uv, stop_uv, start_m, stop_m) < depth_m[:, None]
    low, high = (np.array([f(part.outline, axis=0) for part in solid]) for f in (np.min, np.max))
    touched = raster.overlaps(places.low[:, None], places.high[:, None], low, high)
    touched[:, :things] = True
    return [
        [solid[n].shape for n in np.flatnonzero(row) if not but or solid[n] is not but[k]]
        for k, row in enumerate(before & touched)
    ]


def _phalanges_before(snapshot: Snapshot, places: Places) -> Bool:
    """Which phalanges (N, PHALANGES) reach into the box of a marker before it."""
    low, high = snapshot.outlines[:, 0].min(axis=1), snapshot.outlines[:, 0].max(axis=1)
    found = raster.overlaps(places.low[:, None], places.high[:, None], low, high)
    found &= _depth_along(snapshot, places.uv[:, None], *CAPSULES.T) < places.depth[:, None]
    return found & (places.phalanx[:, None] != np.arange(PHALANGES))


def _sleeve_before(snapshot: Snapshot, places: Places) -> Bool:
    """Whether (N,) the sleeve reaches into the box of a marker before it."""
    sleeve = snapshot.sleeve[0]
    touched = raster.overlaps(places.low, places.high, sleeve.min(axis=0), sleeve.max(axis=0))
    nearer = _depth_along(snapshot, places.uv, *SLEEVE_SPHERES) < places.depth
    return touched & nearer & (not snapshot.into_sleeve)


def _depth_along(snapshot: Snapshot, uv: Float, a: Int | int, b: Int | int) -> Float:
    """Depth (...) [m] of lines between key points nearest to `uv` (..., 2) [px]."""
    return depth_along(uv, snapshot.uv[a], snapshot.uv[b], snapshot.points[a, 2], snapshot.points[b, 2])
