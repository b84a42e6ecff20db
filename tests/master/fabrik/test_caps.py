"""Tests of the painted caps: centroids worked out by hand, and rendered hands whose true caps are known."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.hand.model import HandJoints
from common.recording.frame_recording import open_recording
from master.estimator.sensors import CameraArrays
from master.fabrik.caps import CapTables, cap_surface, hidden_part, tilted
from master.fabrik.intersection import triangulate
from master.fabrik.settings import CAPS
from tests.hand_helpers import (
    MARKERS,
    RIGHT,
    camera_models,
    cap_bias_px,
    cap_views,
    natural_angles,
    palm,
    rendered,
    rig_file,
)

CAMERAS = tuple(camera_models(rig_file()).values())
TABLES = CapTables.of(RIGHT, MARKERS)
RADIUS_M = 0.038 * 0.19  # index tip of the generated hand; its cap's centroid lies 0.15 of it ahead


def hidden_px(area_px2: Float, points: Float, whole_m2: Float, caps: CapTables = TABLES) -> Float:
    """Standard deviation (C, M) [px] that occlusion adds, of areas (C, M) and whole ones (T, C, M)."""
    away = np.stack([np.linalg.norm(points - camera.centre, axis=1) for camera in CAMERAS])
    out = np.empty_like(area_px2)
    for m in range(area_px2.shape[1]):
        found, scale_m = np.empty(len(CAMERAS)), away[:, m] / 500.0
        area, whole = np.ascontiguousarray(area_px2[:, m]), np.ascontiguousarray(whole_m2[..., m])
        hidden_part(caps, int(caps.row[m]), area, scale_m, whole, len(whole_m2), found)
        out[:, m] = np.sqrt(found)
    return out


def pointing(rotation: Float) -> HandJoints:
    """All joints with the same orientation; caps use nothing else."""
    return HandJoints(np.zeros((26, 3)), np.broadcast_to(rotation, (26, 3, 3)), np.eye(4))


@given(st.floats(3e-3, 12e-3), st.floats(-0.5, 0.5))
def test_the_sampled_centroid_is_the_profiles_point(radius_m: float, share: float) -> None:
    """Half a sphere: r / 2 ahead of its centre; with a cylinder of length L behind: (r - L) / 2."""
    points, normals, areas = cap_surface(radius_m, share * radius_m)
    np.testing.assert_allclose(
        np.average(points, axis=0, weights=areas), [0, 0, -share * radius_m], atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    length = radius_m - 2 * share * radius_m
    assert areas.sum() == pytest.approx(2 * np.pi * radius_m * (radius_m + length))


def test_a_cap_more_pointed_than_half_a_sphere_is_taken_for_one() -> None:
    points, _, areas = cap_surface(0.01, 0.02)
    assert np.average(points[:, 2], weights=areas) == pytest.approx(-0.005)


def test_a_cap_seen_from_its_end_has_no_bias_sideways() -> None:
    points = np.tile([0.0, 0.0, 0.5], (6, 1))
    bias = cap_bias_px(pointing(np.eye(3)), points, CAMERAS)  # -z, the finger's end, looks at the left camera
    np.testing.assert_allclose(bias[0], 0.0, atol=1e-9)
    assert (np.abs(bias[1, :5, 0]) > 0.01).all()  # the right one sees it from the side


def test_a_cap_seen_from_the_side_is_seen_behind_its_centroid() -> None:
    """Silhouette: half a disc (centroid 4 r / 3 pi ahead) and a rectangle 2 r x L behind, L = 0.7 r."""
    disc, rectangle = np.pi / 2, 2 * 0.7
    seen = (disc * 4 / (3 * np.pi) - rectangle * 0.35) / (disc + rectangle)
    expected_px = (seen - 0.15) * RADIUS_M * 500.0 / 0.5
    to_the_right = np.array(
        [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    )  # -z of the joint is +x of the rig
    points = np.tile([0.0, 0.0, 0.5], (6, 1))
    bias = cap_bias_px(pointing(to_the_right), points, CAMERAS)[0, 1]
    # What is seen lies nearer by up to a radius, which on the axis moves nothing.
    np.testing.assert_allclose(bias, [expected_px, 0.0], rtol=0.05, atol=1e-6)
    assert expected_px == pytest.approx(-0.654, abs=1e-3)


def test_a_flat_marker_and_one_not_found_have_no_bias() -> None:
    points = np.tile([0.02, 0.01, 0.5], (6, 1))
    points[2] = np.nan
    bias = cap_bias_px(pointing(np.eye(3)), points, CAMERAS)
    np.testing.assert_array_equal(bias[:, 5], 0.0)
    np.testing.assert_array_equal(bias[:, 2], 0.0)
    assert (np.abs(bias[:, 0]).max(axis=-1) > 0).all()


def test_markers_without_caps_have_no_tables_and_the_same_hand_has_its_own_once() -> None:
    back = CapTables.of(RIGHT, ("back", "cube"))
    assert back.row.tolist() == [-1, -1]
    assert len(back.appearances) == len(back.radius_m) == 0
    points = np.array([[0.0, 0.0, 0.5]] * 2)
    np.testing.assert_array_equal(hidden_px(np.full((2, 2), 3.0), points, np.zeros((1, 2, 2)), back), 0.0)
    assert CapTables.of(RIGHT, MARKERS) is TABLES


@pytest.mark.filterwarnings("error")
def test_a_marker_that_shows_nothing_at_all_is_hidden_and_no_error() -> None:
    points = np.tile([0.0375, 0.0, 0.5], (6, 1))
    found = hidden_px(np.zeros((2, 6)), points, np.full((1, 2, 6), 2e-4))
    radius = RADIUS_M * 500.0 / np.linalg.norm(points[0] - CAMERAS[0].centre)
    np.testing.assert_allclose(found[:, 1], radius)
    np.testing.assert_array_equal(found[:, 5], 0.0)


@given(st.integers(0, 2**32 - 1))
def test_a_bias_is_never_larger_than_a_finger_tip(seed: int) -> None:
    rng = np.random.default_rng(seed)
    joints = RIGHT.forward(palm(rng.uniform(-180, 180, 3)), natural_angles(rng))
    points = rng.uniform([-0.1, -0.1, 0.3], [0.1, 0.1, 1.0], (6, 3))
    bias_m = cap_bias_px(joints, points, CAMERAS) * points[:, 2:] / 500.0
    assert (np.linalg.norm(bias_m, axis=-1) < 1.3 * RIGHT.radius_m.max()).all()


def test_a_sliver_of_a_cap_is_hidden_and_a_whole_one_is_not() -> None:
    points = np.tile([0.0, 0.0, 0.5], (6, 1))
    whole_m2 = (2 * 1.7 + np.pi / 2 - 1) * RADIUS_M**2  # from the side: half a disc, and the paint behind it
    whole_px2 = whole_m2 * (500.0 / 0.5) ** 2
    area = np.array([[whole_px2] * 6, [0.1 * whole_px2] * 6])
    expected_m2 = np.full((1, 2, 6), whole_m2)
    found = hidden_px(area, points, expected_m2)
    away = np.linalg.norm(points[1] - CAMERAS[1].centre)
    expected = (1 - 0.1 * (away / 0.5) ** 2) * RADIUS_M * 500.0 / away
    assert found[1, 1] == pytest.approx(expected)
    assert found[0, 1] == pytest.approx(0.2 * expected * away / 0.5)  # what hides it there may reach in here
    alone = np.array([[np.nan] * 6, 0.4 * area[0]])
    assert hidden_px(alone, points, expected_m2)[1, 1] > 0.4 * RADIUS_M * 500.0 / away
    # One that both see alike may be a smaller cap, as far as a radius may be wrong.
    both = hidden_px(0.4 * area[:1] * np.array([[1.0], [(0.5 / away) ** 2]]), points, expected_m2)
    np.testing.assert_allclose(both[:, 1], 0.5 * RADIUS_M * 500.0 / np.array([0.5, away]))
    nowhere = hidden_px(np.full((2, 6), np.nan), points, expected_m2)
    np.testing.assert_array_equal(nowhere, np.zeros((2, 6)))


def test_a_cap_of_another_radius_is_whole_and_one_that_two_cameras_see_unlike_is_not() -> None:
    points = np.tile([0.0375, 0.0, 0.5], (6, 1))  # as far from one camera as from the other
    expected_m2 = np.stack([np.full((2, 6), 2e-4), np.full((2, 6), 3e-4)])  # as its direction may be
    px2_m2 = (500.0 / float(np.linalg.norm(points[0] - CAMERAS[0].centre))) ** 2
    smaller = np.full((2, 6), 0.81 * 2e-4 * px2_m2)  # a radius smaller by a tenth
    np.testing.assert_array_equal(hidden_px(smaller, points, expected_m2)[:, :5], 0.0)
    smaller[1] *= 0.75
    found = hidden_px(smaller, points, expected_m2)[:, 1]
    np.testing.assert_allclose(found, np.array([0.05, 0.25]) * RADIUS_M * np.sqrt(px2_m2))
    rotated = expected_m2 * np.array([[[1.0], [1.0]], [[1.0], [0.75]]])  # or it points away from one of them
    np.testing.assert_array_equal(hidden_px(1.1 * smaller / 0.75, points, rotated)[:, 1], 0.0)


def test_a_cap_shows_a_disc_from_its_end_and_its_whole_length_from_the_side() -> None:
    points = np.tile([0.0, 0.0, 0.5], (6, 1))
    shown: list[float] = []
    for ahead in ([0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]):
        rotation = np.zeros((3, 3))
        rotation[:, 2] = np.negative(ahead)
        shown.append(cap_views(RIGHT, MARKERS, pointing(rotation), points, CAMERAS)[1][0, 1])
    np.testing.assert_allclose(shown[0], np.pi * RADIUS_M**2, rtol=0.01)
    np.testing.assert_allclose(shown[1], (np.pi / 2 + 2 * 0.7) * RADIUS_M**2, rtol=0.01)
    assert shown[2] == pytest.approx(0.0, abs=1e-12)  # behind the finger


def test_a_sure_pose_is_not_tilted_and_an_uncertain_one_about_its_own() -> None:
    R, sd = np.eye(3)[None], np.array([0.2, 0.05])
    sure, unsure = np.empty((CAPS.tilted, 3)), np.empty((CAPS.tilted, 3))
    tilted(0, R, np.zeros((1, 3, 3)), 0.0, sure)
    np.testing.assert_allclose(sure, np.broadcast_to([0.0, 0.0, -1.0], (CAPS.tilted, 3)), atol=1e-12)
    tilted(0, R, np.diag([*sd**2, 0.0])[None], 0.0, unsure)
    np.testing.assert_allclose(np.linalg.norm(unsure, axis=-1), 1.0)
    np.testing.assert_allclose(np.sqrt((unsure[1:, :2] ** 2).mean(axis=0)), sd, rtol=0.05)
    old = np.empty((CAPS.tilted, 3))
    tilted(0, R, np.zeros((1, 3, 3)), 0.1**2, old)  # its age alone
    np.testing.assert_allclose(np.sqrt((old[1:, :2] ** 2).mean(axis=0)), [0.1, 0.1], rtol=0.05)


@pytest.mark.parametrize("name", ["static", "flex90"])
def test_the_correction_brings_rendered_silhouettes_to_their_caps(datasets: Path, name: str) -> None:
    folder = datasets / "stereo" / name
    model, T, angles, _ = rendered(folder)
    manifest = open_recording(folder).manifest
    rig = manifest.marker_rig()
    cameras = tuple(CameraModel.of(manifest.cameras[c], rig.camera_pose(c)) for c in rig.cameras)
    arrays = CameraArrays.of(cameras)
    with np.load(folder / "truth.npz") as truth:
        uv, clear, centroid = truth["uv_ref"], truth["frac_ref"].min(axis=1) > 0.9, truth["paint_centroid"]
    error_mm: dict[str, list[float]] = {"plain": [], "corrected": []}
    for row in range(len(uv)):
        plain = triangulate(arrays, uv[row]).points_m
        bias = cap_views(model, MARKERS, model.forward(T[row], angles[row]), plain, cameras)[0]
        corrected = triangulate(arrays, uv[row] - bias).points_m
        fingers = clear[row] & (np.arange(6) < 5)
        for key, points in (("plain", plain), ("corrected", corrected)):
            error_mm[key] += list(1e3 * np.linalg.norm(points - centroid[row], axis=1)[fingers])
    assert len(error_mm["plain"]) >= 3
    assert np.median(error_mm["plain"]) > 2.0
    assert np.median(error_mm["corrected"]) < 1.0


def test_a_flat_marker_is_uncertain_where_another_camera_sees_much_more_of_it() -> None:
    points = np.tile([0.0375, 0.0, 0.5], (6, 1))  # as far from one camera as from the other
    whole, nothing = np.full(6, 500.0), np.zeros((1, 2, 6))
    alike = hidden_px(np.stack([whole, 0.7 * whole]), points, nothing)
    np.testing.assert_array_equal(
        alike[:, 5], 0.0
    )  # side by side: all of a pair's observations stay as they are
    aslant = hidden_px(np.stack([whole, 0.2 * whole]), points, nothing)
    np.testing.assert_allclose(aslant[:, 5], [0.0, 0.8 * 0.5 * np.sqrt(500.0)])
    alone = hidden_px(np.stack([np.full(6, np.nan), 0.2 * whole]), points, nothing)
    np.testing.assert_array_equal(alone[:, 5], 0.0)
