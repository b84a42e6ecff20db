"""Beads of an object by its motion: within 0.3 mm of the truth; what is too little, loose or in one line is refused."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as replaced

from common.arrays import Float
from common.errors import CalibrationError, FitError
from common.geometry.transforms import fit_rigid, rigid, rotation_vector_to_matrix, transform
from common.messages import MarkerDetections
from master.calibrate.object.beads import (
    Measurement,
    changes,
    fit_bundle,
    frame_of,
    measure_object,
    own_frame,
)
from master.calibrate.observations import Observations, points_of_detections, points_of_poses, rows_of
from tests.master.calibrate.object.motions import BEADS, MODELS, PLACES_M, RATES, RIG, body, messages, seen
from tests.picture_helpers import mirrored


def off_mm(found: Measurement) -> Float:
    """Of each bead from the truth, laid onto it."""
    T = fit_rigid(PLACES_M, found.bundle.beads_m)
    return 1e3 * np.linalg.norm(transform(T, found.bundle.beads_m) - PLACES_M, axis=1)


@pytest.fixture(scope="module")
def motion() -> Observations:
    """One motion of five seconds."""
    return seen(1)


def test_beads_are_found_within_three_tenths_of_a_millimetre_and_say_how_sure() -> None:
    found = measure_object(seen(9))
    off = off_mm(found)
    assert off.max() < 0.3
    assert (off < 5.0 * 1e3 * found.sigma_m).all()


def test_beads_that_are_seen_wrongly_for_a_while_cost_themselves(motion: Observations) -> None:
    rng = np.random.default_rng(4)
    points = motion.value.copy()
    wrong = rng.choice(len(points), len(points) // 8, replace=False)
    points[wrong, 1] += np.array([0.03, -0.02, 0.01])
    found = measure_object(replace(motion, value=points))
    assert off_mm(found).max() < 0.3
    assert found.outlier_share[1] == pytest.approx(0.125, abs=0.02)
    assert found.outlier_share[[0, 2]].max() < 0.02


def test_four_beads_of_which_one_is_missing_most_of_the_time() -> None:
    """Truth by hand: a body whose pose is known, each bead missing in its turn, then none."""
    rng = np.random.default_rng(6)
    places = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.05, 0.05, 0.08]])
    rotations = rotation_vector_to_matrix(rng.normal(0.0, 0.6, (200, 3)))
    points = np.einsum("tij,bj->tbi", rotations, places) + rng.normal(0.0, 0.1, (200, 1, 3))
    points += rng.normal(0.0, 3e-4, points.shape)
    lost = np.arange(200) % 5
    points[np.flatnonzero(lost < 4), lost[lost < 4]] = np.nan
    cov = np.where(np.isnan(points)[..., None], np.nan, 9e-8 * np.eye(3))
    bundle = fit_bundle(Observations.of("abcd", "rig", range(200), list(points), list(cov)))
    off = transform(fit_rigid(places, bundle.beads_m), bundle.beads_m) - places
    assert np.linalg.norm(off, axis=1).max() < 1.5e-4
    # Chi square of what is left is one for each number that is free.
    assert bundle.spread == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(("bead", "by_mm"), [(0, 5.0), (2, 4.0)])
def test_a_bead_that_is_bent_aside_half_way_is_named(motion: Observations, bead: int, by_mm: float) -> None:
    bundle = fit_bundle(motion)
    way = bundle.beads_m[bead] / np.linalg.norm(bundle.beads_m[bead])
    points = motion.value.copy()
    whole = np.flatnonzero(motion.known.sum(axis=1) >= 3)
    later = whole > len(points) // 2
    points[whole[later], bead] += 1e-3 * by_mm * (bundle.T[later, :3, :3] @ way)
    with pytest.raises(FitError, match=f"not rigid.*{BEADS[bead]} moved"):
        measure_object(replace(motion, value=points))


def camera_moved(uv: Float, share: float) -> Float:
    return uv + np.array([4.0 * (share > 0.5), 0.0])


def few(uv: Float, share: float) -> Float:
    return uv + (0.0 if share < 0.15 else np.nan)


def never(uv: Float, _share: float) -> Float:
    return np.full_like(uv, np.nan)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (camera_moved, "not rigid.* a camera moved meanwhile"),
        (mirrored, "all beads are seen by two cameras at"),
        (few, r"three beads|all beads .* at least 60"),
        (never, "no bead is seen by two cameras at once"),
    ],
)
def test_a_fault_of_one_camera_is_refused_by_name(
    change: Callable[[Float, float], Float], cause: str
) -> None:
    sent, camera = messages(1), RIG.cameras[1]
    last, first = max(one.t_ns for one in sent), min(one.t_ns for one in sent)
    wrong = list[MarkerDetections]()
    for one in sent:
        uv = change(one.uv, (one.t_ns - first) / (last - first)) if one.camera == camera else one.uv
        seen_px = np.where(np.isnan(uv[:, 0]), np.nan, one.sigma_px)
        wrong.append(replaced(one, uv=uv, sigma_px=seen_px))
    with pytest.raises(FitError, match=cause):
        measure_object(points_of_detections(RIG, MODELS, RATES, wrong, BEADS))


def test_distances_of_what_is_rigid_stay_far_below_what_is_refused(motion: Observations) -> None:
    assert max(by / most for by, most in changes(motion).values()) < 0.5


def test_beads_in_one_line_are_refused() -> None:
    line = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.05, 0.002, 0.0]])
    with pytest.raises(FitError, match="lie in one line"):
        own_frame(line, BEADS)


def test_a_bead_that_one_camera_sees_is_named(motion: Observations) -> None:
    points = motion.value.copy()
    points[20:, 2] = np.nan
    with pytest.raises(FitError, match=r"at 20 of \d+ epochs.*wand3 7 %"):
        measure_object(replace(motion, value=points))


def test_an_object_that_is_not_turned_is_refused() -> None:
    still = seen(7, 2.0, 1e-3)
    at_rest = replace(still, value=np.repeat(still.value[:1], len(still.t_s), axis=0))
    with pytest.raises(FitError, match="1 ways of turning and places"):
        measure_object(at_rest)


def test_markers_that_the_rig_does_not_have_are_refused_with_what_to_write() -> None:
    with pytest.raises(CalibrationError, match=r'free_markers.*"wand1", "knob"'):
        rows_of(RIG, ("wand1", "knob"))
    with pytest.raises(CalibrationError, match="free_markers: 'thumb'"):
        rows_of(RIG, ("thumb", "wand1", "wand2"))


def test_no_pose_is_nothing_seen() -> None:
    with pytest.raises(FitError, match="no bead is seen"):
        measure_object(points_of_poses((), RIG, BEADS))


def test_own_frame_is_as_documented() -> None:
    rotated = rigid(rotation_vector_to_matrix(np.array([0.4, -1.0, 0.3])), np.array([0.2, 0.1, 0.5]))
    own = transform(own_frame(transform(rotated, PLACES_M), BEADS), transform(rotated, PLACES_M))
    np.testing.assert_allclose(own.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose((own[1] - own[0])[1:], 0.0, atol=1e-12)
    assert own[1, 0] > own[0, 0]
    assert own[2, 1] > own[0, 1]
    np.testing.assert_allclose(own[:, 2], 0.0, atol=1e-12)  # three beads


def test_the_frame_of_a_file_is_kept_or_refused() -> None:
    rotated = rigid(rotation_vector_to_matrix(np.array([0.4, -1.0, 0.3])), np.array([0.2, 0.1, 0.5]))
    T, misses = frame_of(transform(rotated, PLACES_M), BEADS, body(), "body.json")
    np.testing.assert_allclose(T @ rotated, np.eye(4), atol=1e-9)
    assert max(misses.values()) < 1e-9
    with pytest.raises(FitError, match=r"body.json: wand. lies .* mm from where the file has it"):
        frame_of(PLACES_M[[1, 0, 2]], BEADS, body(), "body.json")
    with pytest.raises(FitError, match="has 2 of the beads"):
        frame_of(PLACES_M, ("wand1", "wand2", "knob"), body(), "body.json")
