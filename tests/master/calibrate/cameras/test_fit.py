"""Fits of cameras against truth: errors in mm, degrees and pixels; wrong views found, good ones kept."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import cv2
import numpy as np
import pytest

from common.arrays import Float
from common.errors import FitError
from common.geometry.transforms import axis_rotation, invert, rigid
from master.calibrate.cameras.boards import Charuco, Checkerboard, ImageObservation, board_corners, orderings
from master.calibrate.cameras.fit import CamerasFit, fit_cameras
from master.calibrate.cameras.result import report_lines, result
from master.calibrate.cameras.views import BoardViews, View
from master.calibrate.tree_files import lens_of
from tests.master.calibrate.cameras.board_scenes import SIZE, Scene, nudged, scene

NOISE_PX = 0.1


def flat_fit(views: BoardViews, held: Mapping[str, Float] | None = None) -> CamerasFit:
    """The fit of a board as drawn: to choose between flat and bent takes most of the time, and has its own tests."""
    return fit_cameras(views, held, bent=False)


def errors(fit: CamerasFit, truth: Scene) -> tuple[float, float, float]:
    """Worst focal length [px], place [mm] and turn [degrees] of the cameras."""
    focal, place, rotation = [0.0], [0.0], [0.0]
    for i, camera in enumerate(fit.views.cameras):
        T, E = truth.T_camera_rig[camera], fit.solution.bundle.T_camera_rig[i]
        focal.append(abs(fit.solution.bundle.lenses[i, 0] - truth.lenses[camera][0]))
        place.append(1e3 * float(np.linalg.norm(invert(T)[:3, 3] - invert(E)[:3, 3])))
        rotation.append(float(np.degrees(np.linalg.norm(cv2.Rodrigues(T[:3, :3].T @ E[:3, :3])[0]))))
    return max(focal), max(place), max(rotation)


def with_observation(
    views: BoardViews, name: str, camera: str, change: Callable[[ImageObservation], ImageObservation]
) -> BoardViews:
    """The views with one sighting changed."""
    changed = tuple(
        replace(view, observations={**view.observations, camera: change(view.observations[camera])})
        if view.name == name
        else view
        for view in views.views
    )
    return replace(views, views=changed)


@pytest.mark.parametrize(("cameras", "seed"), [(1, 1), (4, 1)])
def test_cameras_are_found_where_they_are(cameras: int, seed: int) -> None:
    truth = scene(seed, cameras, views=16, shape_mm=0.1)
    fit = fit_cameras(truth.views(NOISE_PX, seed), bent=True)  # less than 16 views tell for certain
    focal, place, rotation = errors(fit, truth)
    assert focal < 2.0
    assert place < 0.8
    assert rotation < 0.15
    assert not fit.rejected
    # 0.1 px per coordinate is 0.14 px per corner, less what was spent on the estimate.
    assert 0.11 < fit.rms_px < 0.15


@pytest.mark.parametrize(("cameras", "seed"), [(2, 0), (3, 1)])
def test_boards_that_moved_between_exposures_are_parted_and_no_good_view_is(cameras: int, seed: int) -> None:
    truth = scene(seed, cameras, views=14, shape_mm=0.1)
    rng = np.random.default_rng(seed)
    wrong = {int(i) for i in rng.choice(14, 4, replace=False)}
    moved = {(i, "right"): nudged(truth.T_rig_board[i], float(rng.uniform(2, 8)), i) for i in sorted(wrong)}
    truth = replace(truth, moved=moved)
    fit = fit_cameras(truth.views(NOISE_PX, seed), bent=True)
    assert fit.board.reason == "as asked for"
    found = {int(no.view) for no in fit.rejected}
    assert found >= wrong
    assert len(found - wrong) <= 1
    # Both images of a moved board still serve their own lens, and the other cameras of three still agree.
    assert {int(shot.view) for shot in fit.shots} >= wrong
    if cameras == 3:
        assert all(no.camera in ("right", "") for no in fit.rejected)
    assert errors(fit, truth)[1] < 0.8


def test_wrong_blurred_and_partly_wrong_detections_are_left_out_with_the_reason() -> None:
    truth = scene(7, 2, views=16)
    views = truth.views(NOISE_PX, 7)
    rng = np.random.default_rng(7)

    def half_wrong(seen: ImageObservation) -> ImageObservation:
        uv = seen.corners_px.copy()
        uv[:20] += rng.normal(0.0, 3.0, (20, 2))
        return replace(seen, corners_px=uv)

    def noise(seen: ImageObservation) -> ImageObservation:
        return replace(seen, corners_px=seen.corners_px + rng.normal(0.0, 2.0, seen.corners_px.shape))

    def mirrored(seen: ImageObservation) -> ImageObservation:
        return replace(seen, corners_px=seen.corners_px.reshape(6, 9, 2)[:, ::-1].reshape(-1, 2))

    def blurred(seen: ImageObservation) -> ImageObservation:
        return replace(seen, blur_px=4.0)

    planted = {
        ("02", "left"): half_wrong,
        ("05", "right"): noise,
        ("09", "left"): mirrored,
        ("12", "right"): blurred,
    }
    for (name, camera), change in planted.items():
        views = with_observation(views, name, camera, change)
    fit = flat_fit(views)
    reasons = {(no.view, no.camera): no.reason for no in fit.rejected}
    assert reasons.keys() == {("02", "left"), ("05", "right"), ("09", ""), ("12", "right")}
    assert "px rms" in reasons["02", "left"]
    assert "disagree" in reasons["09", ""]  # a mirrored board is a good board, elsewhere
    assert "blurred" in reasons["12", "right"]
    assert errors(fit, truth)[1] < 0.5


def test_a_board_that_looks_the_same_turned_is_turned_right() -> None:
    for board in (Checkerboard(7, 5, 0.03), Checkerboard(6, 6, 0.03)):
        truth = scene(11, 2, views=12, board=board)
        views = truth.views(NOISE_PX, 11)
        rotations = orderings(board)
        assert len(rotations) == (2 if board.columns == 7 else 4)
        for i, view in enumerate(views.views):
            order = rotations[i % len(rotations)]
            views = with_observation(
                views, view.name, "right", lambda s, order=order: replace(s, corners_px=s.corners_px[order])
            )
        fit = flat_fit(views)
        assert not fit.rejected
        assert errors(fit, truth)[1] < 0.5


def test_charuco_views_that_show_parts_of_the_board_link_cameras_too() -> None:
    board = Charuco(9, 7, 0.03, 0.022)
    truth = scene(12, 2, views=14, board=board)
    views = truth.views(NOISE_PX, 12)
    rng = np.random.default_rng(12)
    for view in views.views:
        for camera in view.observations:
            hidden = rng.permutation(len(board_corners(board)))[:20]

            def hide(
                seen: ImageObservation, hidden: "np.ndarray[tuple[int], np.dtype[np.int64]]" = hidden
            ) -> ImageObservation:
                uv = seen.corners_px.copy()
                uv[hidden] = np.nan
                return replace(seen, corners_px=uv)

            views = with_observation(views, view.name, camera, hide)
    fit = flat_fit(views)
    assert not fit.rejected
    assert errors(fit, truth)[1] < 0.6


def test_cameras_are_chained_through_shared_views_and_islands_are_named() -> None:
    truth = scene(13, 3, views=21)
    views = truth.views(NOISE_PX, 13)

    def only(view: View, cameras: set[str]) -> View:
        return replace(view, observations={c: s for c, s in view.observations.items() if c in cameras})

    # left and top never see the board together.
    chain = [{"left", "right"}, {"right", "top"}, {"left", "right"}]
    linked = tuple(only(view, chain[i % 3]) for i, view in enumerate(views.views))
    fit = flat_fit(replace(views, views=linked))
    assert errors(fit, truth)[1] < 1.0
    islands = tuple(only(view, [{"left", "right"}, {"top"}][i % 2]) for i, view in enumerate(views.views))
    with pytest.raises(FitError, match=r"\{left, right\} and \{top\} share no view"):
        flat_fit(replace(views, views=islands))


def test_a_held_lens_stays_and_a_wrong_one_shows_in_the_rms() -> None:
    truth = scene(14, 2, views=12)
    views = truth.views(NOISE_PX, 14)
    held = {name: lens.copy() for name, lens in truth.lenses.items()}
    fit = flat_fit(views, held)
    np.testing.assert_array_equal(fit.solution.bundle.lenses, np.stack(list(held.values())))
    assert errors(fit, truth)[1] < 0.3
    assert not result(fit, held).lenses["left"].estimated
    held["left"][0] += 20.0
    assert flat_fit(views, held).rms_px > 1.5 * fit.rms_px


def test_terms_of_the_distortion_are_zero_unless_the_views_show_them() -> None:
    truth = scene(15, 1, views=16)
    plain = {"left": np.array([530.0, 530.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0, 0.0])}
    lens = flat_fit(replace(truth, lenses=plain).views(NOISE_PX, 15)).solution.bundle.lenses[0]
    assert not lens[4:].any()
    barrel = {"left": np.array([530.0, 530.0, 320.0, 240.0, -0.3, 0.1, 0.002, 0.0, 0.0])}
    lens = flat_fit(replace(truth, lenses=barrel).views(NOISE_PX, 15)).solution.bundle.lenses[0]
    assert lens[4] == pytest.approx(-0.3, abs=0.02)
    assert lens[6] == pytest.approx(0.002, abs=0.0005)
    assert lens[8] == 0.0


def test_a_lens_that_folds_inside_the_picture_is_refused_and_not_written() -> None:
    truth = scene(15, 1, views=16)
    folds = {
        "left": np.array([530.0, 530.0, 320.0, 240.0, -0.34, 0.0, 0.0, 0.0, 0.0])
    }  # 350 px from the axis
    fit = flat_fit(replace(truth, lenses=folds).views(NOISE_PX, 15))
    with pytest.raises(
        FitError, match=r"camera 'left': the fit cannot be used: .* the lens folds 3\d\d px from"
    ):
        result(fit, {})


def test_parallel_views_do_not_give_a_focal_length() -> None:
    truth = scene(16, 1, views=16, tilt_deg=0.0)
    with pytest.raises(FitError, match=r"focal length is not determined.*tilt the board"):
        result(flat_fit(truth.views(NOISE_PX, 16)), {})


def test_corners_in_a_small_part_of_the_image_leave_the_distortion_as_uncertain_as_it_is() -> None:
    truth = scene(17, 1, views=20)
    views = truth.views(NOISE_PX, 17)
    middle, near = (np.array(SIZE) - 1.0) / 2.0, 0.16 * np.array(SIZE)

    def cut(seen: ImageObservation) -> ImageObservation:
        inside = np.all(np.abs(seen.corners_px - middle) < near, axis=1)
        return replace(seen, corners_px=np.where(inside[:, None], seen.corners_px, np.nan))

    for view in views.views:
        views = with_observation(views, view.name, "left", cut)
    kept = tuple(view for view in views.views if view.observations["left"].seen >= 12)
    found = result(flat_fit(replace(views, views=kept)), {})
    lens, true = found.lenses["left"], truth.lenses["left"]
    assert lens.covered.share < 0.25
    assert any("ordinary lens" in line for line in report_lines(found))
    values = lens_of(lens.intrinsics)
    assert lens.sd[5] > 0.1  # k2, which shows in the corners of the image
    assert np.less(np.abs(values - true)[:6], 3.0 * lens.sd[:6]).all()


def test_too_few_views_and_views_that_contradict_each_other_are_refused() -> None:
    truth = scene(18, 2, views=12)
    views = truth.views(NOISE_PX, 18)
    with pytest.raises(FitError, match="seen in 3 images, at least 4"):
        flat_fit(replace(views, views=views.views[:3]))
    rng = np.random.default_rng(18)
    for view in views.views[:8]:
        views = with_observation(
            views,
            view.name,
            "left",
            lambda s: replace(
                s, corners_px=s.corners_px + rng.normal(0, 25 * rng.uniform(0.3, 3), s.corners_px.shape)
            ),
        )
    with pytest.raises(FitError, match=r"camera 'left': .*(agree|px rms)"):
        result(flat_fit(views), {})


def test_a_picture_upside_down_among_three_cameras_is_parted_however_far_it_drives_the_board() -> None:
    truth = scene(50, 3, views=14)
    views = truth.views(NOISE_PX, 50)
    name = next(view.name for view in views.views if len(view.observations) == 3)
    views = with_observation(
        views, name, "top", lambda s: replace(s, corners_px=np.array([639.0, 479.0]) - s.corners_px)
    )
    fit = flat_fit(views)
    assert [(no.view, no.camera) for no in fit.rejected] == [(name, "top")]
    assert errors(fit, truth)[1] < 0.8


@pytest.mark.parametrize(("shape_mm", "bent"), [(0.3, True), (0.0, False)])
def test_a_bent_board_is_distinguished_from_a_flat_one_by_views_held_out(shape_mm: float, bent: bool) -> None:
    truth = scene(21, 2, views=12, shape_mm=shape_mm)
    fit = fit_cameras(truth.views(NOISE_PX, 21))
    assert fit.board.bent == bent == bool(fit.solution.bundle.shape_m.any())
    assert fit.board.views == 12
    assert (fit.board.bent_px < 0.8 * fit.board.flat_px) == bent
    # Placed by half of its corners, the other half is off by little more than its noise.
    assert min(fit.board.flat_px, fit.board.bent_px) == pytest.approx(NOISE_PX * 2**0.5, rel=0.25)
    (line,) = [line for line in report_lines(result(fit, {})) if line.startswith("board:")]
    assert ("taken as drawn" not in line) == bent
    for figure in ("12 views held out", f"{fit.board.flat_px:.3f} px", f"{fit.board.bent_px:.3f} px"):
        assert figure in line


def test_few_noisy_corners_of_a_flat_board_are_not_taken_for_a_bent_one() -> None:
    truth = scene(22, 2, views=16, board=Charuco(4, 5, 0.054, 0.0405))
    fit = fit_cameras(truth.views(1.0, 22))
    assert not fit.board.bent
    assert not fit.solution.bundle.shape_m.any()
    assert fit.board.views == 16  # it was compared


def test_few_views_take_the_board_as_drawn_and_say_so() -> None:
    views = scene(23, 1, views=7, shape_mm=0.3).views(NOISE_PX, 23)
    fit = fit_cameras(views)
    assert not fit.board.bent
    assert "7 views are too few to determine its shape, at least 8" in fit.board.reason
    with pytest.raises(FitError, match="7 good views are too few for the board's own shape"):
        fit_cameras(views, bent=True)


@pytest.mark.parametrize(("cameras", "named"), [(2, "'left' or 'right'"), (3, "'right'")])
@pytest.mark.parametrize(("turn_deg", "shift_mm"), [(0.5, 0.0), (0.0, 5.0)])
def test_a_camera_that_moved_between_the_views_is_named(
    cameras: int, named: str, turn_deg: float, shift_mm: float
) -> None:
    still, moves = scene(3, cameras), 9
    move = rigid(axis_rotation(1, np.radians(turn_deg)), np.array([1e-3 * shift_mm, 0.0, 0.0]))
    T = still.T_camera_rig["right"]
    after = {(v, "right"): invert(T) @ move @ T @ still.T_rig_board[v] for v in range(moves, 18)}
    with pytest.raises(FitError, match=f"camera {named} moved between the views 08 and 09"):
        fit_cameras(replace(still, moved=after).views(0.1, 3))
