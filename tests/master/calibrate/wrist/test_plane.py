"""The laser plane: from rendered views of several devices, and exact lines for everything that must be refused."""

import numpy as np
import pytest

from common.arrays import Float
from common.errors import FitError
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.recording.frame_recording import Illumination
from master.calibrate.wrist.device import BoardPose, LitView
from master.calibrate.wrist.laser_plane import ViewLine, fit_plane, lines_of
from tests.master.calibrate.wrist.devices import (
    BOARD,
    FOCAL_PX,
    OPTICS,
    angle_deg,
    cycles_of,
    plane_of,
    view_of,
)

NORMAL = np.array([0.0, 0.995, 0.0998749218])
OFFSET_M = 0.03
BOARD_SIGMA = np.diag([5e-4, 5e-4, 5e-4, 2e-5, 2e-5, 4e-5]) ** 2


def view_line(
    name: str, rotation_deg: tuple[float, float, float], centre: tuple[float, float, float]
) -> ViewLine:
    """Exact line of the plane on a board at `centre` [m], turned about the camera's axes."""
    rotation = rotation_vector_to_matrix(np.radians(rotation_deg))
    facing, at = rotation[:, 2], np.array(centre)
    way = np.cross(facing, NORMAL)
    way /= np.linalg.norm(way)
    # The point of both planes nearest to the centre.
    system = np.stack([facing, NORMAL, way])
    point = np.linalg.solve(system, np.array([facing @ at, OFFSET_M, way @ at]))
    points = point + np.linspace(-0.05, 0.05, 60)[:, None] * way
    ends = point + np.array([[-0.03], [0.03]]) * way
    placed = BoardPose(rigid(rotation, at), at, BOARD_SIGMA, 0.06)
    return ViewLine(name, points, ends, placed, 0.02, FOCAL_PX)


def shifted(line: ViewLine, by: Float) -> ViewLine:
    """The same line elsewhere."""
    return ViewLine(
        line.name, line.points_m + by, line.ends_m + by, line.placed, line.sigma_px, line.focal_px
    )


GOOD = (
    view_line("near", (0.0, 0.0, 0.0), (0.0, 0.03, 0.15)),
    view_line("far", (20.0, 5.0, 0.0), (0.02, 0.0, 0.32)),
    view_line("left", (-10.0, 35.0, 0.0), (-0.05, 0.02, 0.22)),
    view_line("right", (0.0, -35.0, 10.0), (0.05, 0.01, 0.22)),
)


def test_rendered_views_give_the_plane_to_a_tenth_of_a_degree_and_millimetre() -> None:
    seed = 11  # of twelve devices: `bench/wrist/calibration.py`
    views = tuple(view_of(str(k), frames) for k, frames in enumerate(cycles_of(seed, 6)))
    fit = fit_plane(lines_of(views, BOARD, OPTICS)[0])
    true = plane_of(seed)
    off_deg = angle_deg(np.array(fit.plane.normal), np.array(true.normal))
    off_mm = 1e3 * abs(fit.plane.offset_m - true.offset_m)
    assert off_deg < 0.05  # the bar is 0.1
    assert off_mm < 0.05
    # Its own doubt covers the error, and is not so wide that it says nothing.
    assert off_deg < 4.0 * np.degrees(fit.normal_sigma_rad) + 0.002
    assert off_mm < 4e3 * fit.offset_sigma_m
    assert fit.normal_sigma_rad < np.radians(0.05)


def test_exact_lines_give_the_exact_plane() -> None:
    fit = fit_plane(GOOD)
    assert angle_deg(np.array(fit.plane.normal), NORMAL) < 1e-6
    assert fit.plane.offset_m == pytest.approx(OFFSET_M, abs=1e-8)
    assert fit.used.all()
    assert fit.rms_m < 1e-9


def test_the_stated_sigma_is_that_of_many_repetitions() -> None:
    # Boards drawn from their covariance move the points along their rays, as poses that are a little wrong do.
    rng = np.random.default_rng(5)
    rotations: list[float] = []
    offsets: list[float] = []
    stated = fit_plane(GOOD)
    for _ in range(300):
        noisy: list[ViewLine] = []
        for line in GOOD:
            pull = rng.multivariate_normal(np.zeros(6), BOARD_SIGMA)
            facing = line.placed.T_camera_board[:3, 2]

            def moved(
                points: Float, line: ViewLine = line, pull: Float = pull, facing: Float = facing
            ) -> Float:
                rotated = facing + np.cross(pull[:3], facing)
                at = line.placed.centre_m + pull[3:]
                return points * ((rotated @ at) / (points @ rotated))[:, None]

            noisy.append(
                ViewLine(line.name, moved(line.points_m), moved(line.ends_m), line.placed, 0.02, FOCAL_PX)
            )
        fit = fit_plane(noisy)
        rotations.append(angle_deg(np.array(fit.plane.normal), NORMAL))
        offsets.append(fit.plane.offset_m - OFFSET_M)
    # The floors for line and lens are in the stated sigma and not in these draws.
    assert 0.4 < np.std(offsets) / stated.offset_sigma_m < 1.1
    assert 0.3 < np.sqrt(np.mean(np.square(rotations)) / 2) / np.degrees(stated.normal_sigma_rad) < 1.1


@pytest.mark.parametrize("wrong", [(0.0, 0.004, 0.0), (0.0, -0.02, 0.01)])
def test_a_wrong_view_is_left_out_and_reported(wrong: tuple[float, float, float]) -> None:
    bad = shifted(view_line("wrong", (10.0, 0.0, 5.0), (0.0, 0.02, 0.25)), np.array(wrong))
    fit = fit_plane((*GOOD, bad))
    assert fit.used.tolist() == [True, True, True, True, False]
    assert angle_deg(np.array(fit.plane.normal), NORMAL) < 1e-6
    assert fit.off_m[-1] > 1e-3


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_views_are_refused(count: int) -> None:
    with pytest.raises(FitError, match=f"in {count} views, at least 3 are needed"):
        fit_plane(GOOD[:count])


def test_one_place_of_the_board_again_and_again_is_refused() -> None:
    rng = np.random.default_rng(1)
    same = [shifted(GOOD[0], rng.normal(0.0, 2e-5, 3)) for _ in range(8)]
    with pytest.raises(FitError, match=r"on one line .* hold the board at other distances"):
        fit_plane(same)


def test_boards_turned_about_the_line_itself_are_refused() -> None:
    # Another tilt, but the laser falls on the same line in space: no plane is told.
    line = view_line("0", (0.0, 0.0, 0.0), (0.0, 0.03, 0.2))
    others = [ViewLine(str(k), line.points_m, line.ends_m, line.placed, 0.02, FOCAL_PX) for k in range(5)]
    with pytest.raises(FitError, match="on one line"):
        fit_plane(others)


def test_noise_beyond_the_spread_is_refused() -> None:
    # Distances that differ by a centimetre, poses sure to a degree and a millimetre only.
    unsure = np.diag([0.02, 0.02, 0.02, 1e-3, 1e-3, 1e-3]) ** 2
    lines = [view_line(str(k), (0.0, 0.0, 0.0), (0.0, 0.03, 0.2 + 0.005 * k)) for k in range(3)]
    lines = [
        ViewLine(
            one.name,
            one.points_m,
            one.ends_m,
            BoardPose(one.placed.T_camera_board, one.placed.centre_m, unsure, 0.9),
            0.02,
            FOCAL_PX,
        )
        for one in lines
    ]
    with pytest.raises(FitError, match=r"on one line|is known to"):
        fit_plane(lines)


def test_views_that_contradict_each_other_are_refused() -> None:
    rng = np.random.default_rng(3)
    loose = [shifted(line, rng.normal(0.0, 0.01, 3)) for line in (*GOOD, *GOOD)]
    with pytest.raises(FitError, match=r"views agree on one plane|is known to|on one line"):
        fit_plane(loose)


def lit_in_the_laser_frame(seed: int, count: int, *, board_apart: bool) -> tuple[LitView, ...]:
    """Views without an ambient frame; the laser's shows the board, lit by the LEDs too."""
    views: list[LitView] = []
    for k, frames in enumerate(cycles_of(seed, count)):
        line = frames[Illumination.LASER].astype(int) - frames[Illumination.AMBIENT]
        both = np.clip(frames[Illumination.LED] // 2 + 30 + line, 0, 255).astype(np.uint8)
        own = {Illumination.LASER: both}
        if board_apart:
            own[Illumination.LED] = frames[Illumination.LED]
        views.append(view_of(str(k), own))
    return tuple(views)


@pytest.mark.parametrize("board_apart", [False, True])
def test_a_board_that_is_lit_in_the_laser_frame_needs_no_ambient_one(*, board_apart: bool) -> None:
    seed = 9
    fit = fit_plane(lines_of(lit_in_the_laser_frame(seed, 6, board_apart=board_apart), BOARD, OPTICS)[0])
    true = plane_of(seed)
    assert fit.used.sum() >= 5  # one is too steep for the finder, by whatever light
    assert angle_deg(np.array(fit.plane.normal), np.array(true.normal)) < 0.05
    assert 1e3 * abs(fit.plane.offset_m - true.offset_m) < 0.1


def test_a_lit_board_without_a_line_is_refused() -> None:
    frames = cycles_of(11, 6)
    views = tuple(
        view_of(str(k), {Illumination.LASER: one[Illumination.LED]}) for k, one in enumerate(frames)
    )
    lines, refused = lines_of(views, BOARD, OPTICS)
    assert not lines
    assert len(refused) == 6


def test_a_laser_that_moved_between_the_views_is_refused() -> None:
    # Half of the views before, half after it was knocked: no majority.
    after = [shifted(line, np.array([0.0, 0.004, 0.0])) for line in GOOD[2:]]
    more = view_line("more", (15.0, -20.0, 0.0), (0.03, 0.0, 0.28))
    with pytest.raises(FitError, match=r"only \d of \d views agree .* laser fixed|is known to"):
        fit_plane((*GOOD[:2], *after, shifted(more, np.array([0.0, -0.004, 0.0]))))
