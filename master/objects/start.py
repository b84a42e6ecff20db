"""Initial poses of an object from current observations alone.

A fit starts from these while there is no past.

Tags: each tag in each camera has two poses that show it nearly alike, tilted one way or the other (Collins, Bartoli,
"Infinitesimal Plane-Based Pose Estimation", 2014); both are named. Beads: those that two cameras see are points, and
three of them whose distances are the object's give a pose. Where a slave named two places of a colour, both are tried.
Which of all these is right the fit decides, with all that is seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from common.arrays import Float, Int
from common.calibration.object_profile import tag_corners
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import fit_rigid, invert, rigid
from master.estimator.cameras import CameraArrays
from master.fabrik.intersection import triangulate
from master.objects.features import Features

_COMBINATIONS = 16


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """One feature in one camera, interpolated to the epoch from two frames.

    As well as two frames determine it.

    Attributes:
        camera: Which.
        feature: Which.
        uv: (K, n, 2) [px] n points; K places it may be: one, or two where the slave named an alternative.
    """

    camera: int
    feature: int
    uv: Float


def poses_of_tags(
    sighted: Sequence[Sighted], features: Features, cameras: tuple[CameraModel, ...]
) -> list[Float]:
    """Return two poses `T_rig_object` (4, 4) for each tag in each camera.

    The likelier first.
    """
    poses: list[tuple[float, Float]] = []
    for seen in sighted:
        if seen.feature >= features.beads:
            camera = cameras[seen.camera]
            own = features.points[features.corners_of(seen.feature - features.beads)]
            poses += [
                (miss, camera.T_rig_camera @ T) for miss, T in two_poses(own, camera.undistort(seen.uv[0]))
            ]
    poses.sort(key=lambda pose: pose[0])
    return [T for _, T in poses]


def two_poses(corners: Float, xy: Float) -> list[tuple[float, Float]]:
    """Return the two possible poses of a tag seen at normalised points (4, 2).

    For each, the residual of the corners and `T_camera_object`.

    The derivative J of the homography at the tag's middle, seen from a view turned to it, is a rotation's upper left
    2x2 times a scale; its third row is known but for the sign (ibid., 4.1). OpenCV 5 has this wrong for tags near the
    optical axis.

    Args:
        corners: (4, 3) [m] of the tag, object frame, as printed top left, top right, bottom right, bottom left.
        xy: Where they are seen, undistorted (x/z, y/z).
    """
    edge = 0.25 * float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum())
    flat = tag_corners(edge)
    H = _homography(flat[:, :2], xy)
    if H is None:
        return []
    v = H[:2, 2]
    J = H[:2, :2] - v[:, None] * H[2, :2]
    rotation = _rotation_to(np.array([v[0], v[1], 1.0]))
    try:
        A = np.asarray(np.linalg.solve(rotation[:2, :2] - v[:, None] * rotation[2, :2], J), np.float64)
        A /= float(np.linalg.norm(A, 2))
        return _ways(A, rotation, corners, flat, xy)
    except np.linalg.LinAlgError:  # corners that no tag can have
        return []


def _ways(A: Float, rotation: Float, corners: Float, flat: Float, xy: Float) -> list[tuple[float, Float]]:
    """The two poses of a tag whose turn has `A` (2, 2) as upper left part.

    As `two_poses` returns them.
    """
    left = np.eye(2) - A.T @ A
    b = np.sqrt(np.maximum(np.diagonal(left), 0.0)) * [1.0, 1.0 if left[0, 1] >= 0.0 else -1.0]
    out: list[tuple[float, Float]] = []
    for sign in (1.0, -1.0):
        first = rotation @ np.vstack([A, sign * b])
        u, _, vt = np.linalg.svd(np.column_stack([first, np.cross(first[:, 0], first[:, 1])]))
        R = u @ vt
        T = rigid(R, _shift(flat @ R.T, xy)) @ invert(fit_rigid(corners, flat))
        seen = corners @ T[:3, :3].T + T[:3, 3]
        if (seen[:, 2] > 0.0).all():
            out.append((float(np.linalg.norm(seen[:, :2] / seen[:, 2:] - xy)), T))
    return sorted(out, key=lambda way: way[0])


def _homography(plane: Float, xy: Float) -> Float | None:
    """Return the homography (3, 3) from a plane's points to their images.

    Points (4, 2) and images (4, 2); its last element is 1. None: three of the points are collinear.
    """
    rows = np.zeros((8, 8))
    rows[::2, :2], rows[::2, 2] = plane, 1.0
    rows[1::2, 3:5], rows[1::2, 5] = plane, 1.0
    rows[:, 6:] = -(xy[:, :, None] * plane[:, None]).reshape(8, 2)
    try:
        return np.append(np.linalg.solve(rows, xy.ravel()), 1.0).reshape(3, 3)
    except np.linalg.LinAlgError:
        return None


def _rotation_to(line_of_sight: Float) -> Float:
    """Return the smallest rotation (3, 3) from the z axis to a line of sight.

    The line of sight is the direction of a vector (3,) in front of the camera.
    """
    x, y, z = line_of_sight / np.linalg.norm(line_of_sight)
    cross = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + z)


def _shift(rotated: Float, xy: Float) -> Float:
    """Solve for the origin (3,) of rotated points by linear least squares.

    The rotated points (N, 3) are seen at (N, 2).
    """
    rows = np.zeros((2 * len(xy), 3))
    rows[::2, 0] = rows[1::2, 1] = 1.0
    rows[:, 2] = -xy.ravel()
    return np.asarray(
        np.linalg.lstsq(rows, (xy * rotated[:, 2:] - rotated[:, :2]).ravel(), rcond=None)[0], np.float64
    )


def poses_of_beads(sighted: Sequence[Sighted], features: Features, cameras: CameraArrays) -> list[Float]:
    """Return poses `T_rig_object` (4, 4) from three or more beads.

    Only beads whose mutual distances match the object; the best pose first.
    """
    places = [_points(sighted, bead, cameras) for bead in range(features.beads)]
    seen = [bead for bead, found in enumerate(places) if len(found)]
    poses: list[tuple[float, Float]] = []
    triples = 40
    for triple in list(combinations(seen, 3))[:triples]:
        own = features.points[list(triple)]
        if np.linalg.norm(np.cross(own[1] - own[0], own[2] - own[0])) < 1e-4:  # [m^2]: nearly in one line
            continue
        wanted = _sides(own)
        for associated in list(product(*(range(len(places[bead])) for bead in triple)))[:_COMBINATIONS]:
            points = np.array([places[bead][k] for bead, k in zip(triple, associated, strict=True)])
            off = np.abs(_sides(points) - wanted)
            distance_m, distance_share = 8e-3, 0.08  # by which distances between beads may be wrong
            if (off < distance_m + distance_share * wanted).all():
                poses.append((float(off.sum()), fit_rigid(points, own)))
    poses.sort(key=lambda pose: pose[0])
    # poses
    return [T for _, T in poses[:6]]


def _points(sighted: Sequence[Sighted], bead: int, cameras: CameraArrays) -> Float:
    """Return the possible positions (K, 3) [m] of a bead in the rig frame.

    Of all choices of its image positions, those whose rays meet.
    """
    views = [seen for seen in sighted if seen.feature == bead]
    if len(views) < 2:
        return np.empty((0, 3))
    choices = list(product(*(range(len(seen.uv)) for seen in views)))[:_COMBINATIONS]
    uv = np.full((len(cameras.scale), len(choices), 2), np.nan)
    for seen, associated in zip(views, np.array(choices, np.int64).T, strict=True):
        uv[seen.camera] = seen.uv[associated, 0]
    sigma_px = 0.3
    found = triangulate(cameras, uv, sigma_px)
    miss_px = 6.0  # by which rays of a bead may miss each other
    return found.points_m[found.residual_px < miss_px]


def _sides(points: Float) -> Float:
    """Distances (3,) between three points (3, 3)."""
    return np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)


def reach(taus: Float) -> Int:
    """Select the two times that carry an image position to the epoch.

    `taus` (n,) are times from an epoch [s]; the nearest is first. Returns one index where only one is usable.
    """
    order: Int = np.argsort(np.abs(taus))
    near_s = 0.012  # frames of several cameras that are taken for one moment without bringing them there
    if len(order) < 2 or abs(float(taus[order[1]])) > 4 * near_s:
        return order[:1]
    return order[:2]
