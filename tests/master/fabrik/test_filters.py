"""1 € filter: the published data, a double-precision reference, and what happens around gaps."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import FilterCalibration
from master.fabrik.one_euro import OneEuro, OneEuroParameters, PointFilter

PAPER = OneEuroParameters(1.0, 0.1, 1.0)  # of the published data


class _LowPass:
    """Textbook exponential smoothing (Casiez 2012, algorithm 1), one object per signal."""

    def __init__(self) -> None:
        self.last: float | None = None

    def filter(self, value: float, alpha: float) -> float:
        self.last = value if self.last is None else alpha * value + (1.0 - alpha) * self.last
        return self.last


class _Reference:
    """The paper's filter, written for reading; derivative against the previous filtered value."""

    def __init__(self, min_cutoff: float, beta: float, d_cutoff: float) -> None:
        self.min_cutoff, self.beta, self.d_cutoff = min_cutoff, beta, d_cutoff
        self.x, self.dx = _LowPass(), _LowPass()
        self.t: int | None = None

    @staticmethod
    def alpha(cutoff: float, dt: float) -> float:
        tau = 1.0 / (2.0 * math.pi * cutoff)
        return 1.0 / (1.0 + tau / dt)

    def filter(self, t_ns: int, value: float) -> float:
        if self.t is None or self.x.last is None:
            self.t = t_ns
            self.dx.filter(0.0, 1.0)
            return self.x.filter(value, 1.0)
        dt = (t_ns - self.t) * 1e-9
        self.t = t_ns
        speed = self.dx.filter((value - self.x.last) / dt, self.alpha(self.d_cutoff, dt))
        return self.x.filter(value, self.alpha(self.min_cutoff + self.beta * abs(speed), dt))


def _columns(datasets: Path) -> dict[str, Float]:
    with (datasets / "one_euro" / "groundTruth.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_equals_the_published_ground_truth(datasets: Path) -> None:
    data = _columns(datasets)
    machine = OneEuro(PAPER)
    # the file's times are rounded to six digits; it was made at exactly 120 Hz
    ours = [machine.push(round(k * 1e9 / 120), np.array([v]))[0] for k, v in enumerate(data["noisy"])]
    assert len(ours) == 1200
    assert np.abs(np.array(ours) - data["filtered"]).max() < 1e-5
    machine = OneEuro(PAPER)
    times = np.round(data["timestamp"] * 1e9).astype(np.int64).tolist()
    ours = [machine.push(t, np.array([v]))[0] for t, v in zip(times, data["noisy"], strict=True)]
    assert np.abs(np.array(ours) - data["filtered"]).max() < 1e-4


@pytest.mark.parametrize(
    ("min_cutoff", "beta", "d_cutoff"), [(1.0, 0.1, 1.0), (0.3, 0.0, 2.0), (3.0, 25.0, 0.7)]
)
def test_equals_a_scalar_reference_to_1e_9(min_cutoff: float, beta: float, d_cutoff: float) -> None:
    rng = np.random.default_rng(5)
    times = np.cumsum(rng.integers(2_000_000, 40_000_000, 400)).tolist()
    signals = np.cumsum(rng.normal(0.0, 0.01, (400, 6, 3)), axis=0)
    machine = OneEuro(OneEuroParameters(min_cutoff, beta, d_cutoff))
    ours = np.stack([machine.push(t, s) for t, s in zip(times, signals, strict=True)])
    references = [_Reference(min_cutoff, beta, d_cutoff) for _ in range(18)]
    theirs = np.array(
        [
            [r.filter(t, v) for r, v in zip(references, s.ravel(), strict=True)]
            for t, s in zip(times, signals, strict=True)
        ]
    )
    assert np.abs(ours.reshape(400, 18) - theirs).max() < 1e-9


def test_gap_of_one_signal_leaves_the_others_alone_and_continues_with_true_dt() -> None:
    rng = np.random.default_rng(2)
    times = [8_333_333 * k for k in range(60)]
    signals = rng.normal(0.0, 1.0, (60, 3))
    signals[20:32, 1] = np.nan
    machine = OneEuro(OneEuroParameters(1.0, 0.5, 1.0))
    ours = np.stack([machine.push(t, s) for t, s in zip(times, signals, strict=True)])
    for i in range(3):
        reference = _Reference(1.0, 0.5, 1.0)
        for k, t in enumerate(times):
            if np.isnan(signals[k, i]):
                assert np.isnan(ours[k, i])
            else:
                assert ours[k, i] == pytest.approx(reference.filter(t, signals[k, i]), abs=1e-9)


def test_long_gap_restarts_from_the_value_itself() -> None:
    machine = OneEuro(OneEuroParameters(1.0, 0.0, 1.0, restart_gap_s=0.5))
    machine.push(0, np.array([0.0, 5.0]))
    machine.push(10_000_000, np.array([0.0, np.nan]))
    assert machine.push(490_000_000, np.array([1.0, 9.0]))[1] < 9.0
    assert machine.push(1_000_000_000, np.array([1.0, 2.0]))[0] == 1.0
    # a gap of every signal at once is a gap too
    machine = OneEuro(OneEuroParameters(1.0, 0.0, 1.0))
    machine.push(0, np.zeros(2))
    assert machine.push(600_000_000, np.array([3.0, 4.0])).tolist() == [3.0, 4.0]


def test_zero_is_a_time_and_a_late_sample_changes_nothing() -> None:
    machine, duplicate = OneEuro(PAPER), OneEuro(PAPER)
    for m in (machine, duplicate):
        m.push(0, np.array([0.0]))
    second = machine.push(10_000_000, np.array([1.0]))
    assert 0.0 < second[0] < 1.0  # t = 0 was taken as the time before
    assert duplicate.push(10_000_000, np.array([1.0])) == second
    assert machine.push(10_000_000, np.array([50.0])) == second
    assert machine.push(4, np.array([50.0])) == second
    assert machine.late == 2
    assert machine.push(20_000_000, np.array([2.0])) == duplicate.push(20_000_000, np.array([2.0]))


@given(st.lists(st.sampled_from([0.3, -1.0, math.nan, math.inf]), min_size=2, max_size=40))
def test_nothing_ever_poisons_later_output(values: list[float]) -> None:
    machine = OneEuro(PAPER)
    for k, value in enumerate(values):
        out = machine.push(10_000_000 * k, np.array([value, 1.0]))
        assert math.isfinite(out[0]) == math.isfinite(value)
        assert out[1] == pytest.approx(1.0, abs=1e-12)
    assert -1.0 <= machine.push(10_000_000 * len(values), np.array([0.3, 1.0]))[0] <= 0.3


@given(st.floats(-1e3, 1e3), st.integers(1, 60))
def test_a_constant_stays(value: float, count: int) -> None:
    machine = OneEuro(PAPER)
    for k in range(count):
        out = machine.push(7_000_000 * k, np.array([value]))
    assert out[0] == pytest.approx(value, abs=1e-9)  # pyright: ignore[reportPossiblyUnboundVariable]


@pytest.mark.parametrize(
    "bad",
    [
        (0.0, 0.1, 1.0),
        (1.0, -0.1, 1.0),
        (1.0, 0.1, math.nan),
        (math.inf, 0.1, 1.0),
        (1.0, 0.1, 1.0, 0.0),
        (1.0, 0.1, 1.0, 0.5, 0.0),
        (1.0, 0.1, 1.0, 0.5, math.nan),
    ],
)
def test_parameters_are_checked(bad: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="1 € filter"):
        OneEuroParameters(*bad)


def test_a_rig_file_s_settings_are_the_parameters() -> None:
    settings = FilterCalibration(min_cutoff_hz=2.0, beta=30.0, d_cutoff_hz=3.0, jitter_m=5e-4)
    assert OneEuroParameters.of(settings) == OneEuroParameters(2.0, 30.0, 3.0, jitter=5e-4)


def test_shape_is_kept_and_may_not_change() -> None:
    machine = OneEuro(PAPER)
    assert machine.push(0, np.full((6, 3), np.nan)).shape == (6, 3)
    with pytest.raises(ValueError, match="shape"):
        machine.push(1, np.zeros(18))
    with pytest.raises(ValueError, match="3 variances for 18 signals"):
        machine.push(1, np.zeros((6, 3)), np.ones(3))
    with pytest.raises(ValueError, match="groups of"):
        OneEuro(PAPER, (2, 2)).push(0, np.zeros(3))


def test_read_only_and_transposed_samples_are_taken_as_they_are() -> None:
    samples = np.random.default_rng(8).normal(0.0, 1.0, (20, 4, 3))
    ours, theirs = OneEuro(PAPER), OneEuro(PAPER)
    for k, sample in enumerate(samples):
        rotated = np.asfortranarray(sample)
        rotated.flags.writeable = False
        np.testing.assert_array_equal(ours.push(k * 10_000_000, rotated), theirs.push(k * 10_000_000, sample))


def test_a_group_has_the_cut_off_of_its_fastest_signal_and_another_its_own() -> None:
    times = [8_333_333 * k for k in range(120)]
    rng = np.random.default_rng(3)
    slow, quick = rng.normal(0.0, 1e-3, (2, 120))
    quick += 3.0 * np.arange(120) / 120.0
    grouped = OneEuro(OneEuroParameters(1.0, 5.0, 1.0), (2, 1))
    out = np.array([grouped.push(t, np.array([a, b, a])) for t, a, b in zip(times, slow, quick, strict=True)])
    alone = [_Reference(1.0, 5.0, 1.0) for _ in range(2)]
    expected = np.array(
        [
            [r.filter(t, x) for r, x in zip(alone, (slow[k], quick[k]), strict=True)]
            for k, t in enumerate(times)
        ]
    )
    np.testing.assert_allclose(out[:, 1:], expected[:, ::-1], atol=1e-9)
    # What is slow follows as fast as what moves with it: more of its noise is left.
    assert out[60:, 0].std() > 1.5 * out[60:, 2].std()


def _by_noise(signals: Float, sigma_m: float, groups: tuple[int, ...]) -> Float:
    """Signals (T, N) [m] at 60 Hz, said to have noise of this standard deviation [m]."""
    machine = OneEuro(SETTINGS, groups)
    variance = np.full(signals.shape[1], sigma_m**2)
    return np.array([machine.push(k * 16_666_667, x, variance) for k, x in enumerate(signals)])


@pytest.mark.parametrize(
    ("sigma_m", "output", "left_m"), [(1e-3, 1.0, 4e-4), (1e-3, 2.0, 2e-4), (3e-3, 2.0, 4e-4)]
)
def test_at_rest_known_noise_leaves_about_the_jitter(sigma_m: float, output: float, left_m: float) -> None:
    noise = np.random.default_rng(1).normal(0.0, sigma_m, (2000, 6))
    out = _by_noise(noise, output * sigma_m, (3, 3))[200:]
    assert out.std(axis=0).max() < left_m


@pytest.mark.parametrize("speed_m_s", [0.3, 1.0])
def test_in_motion_known_noise_costs_no_more_lag_than_noise(speed_m_s: float) -> None:
    true = speed_m_s / 60.0 * np.arange(600)[:, None] * [1.0, 0.0]
    out = _by_noise(true + np.random.default_rng(2).normal(0.0, 1e-3, true.shape), 1e-3, (2,))
    paper = OneEuro(SETTINGS)
    behind = (true - np.array([paper.push(k * 16_666_667, x) for k, x in enumerate(true)]))[200:, 0].mean()
    assert abs((true - out)[200:, 0].mean()) < behind + 1e-4


def test_a_motion_that_begins_is_followed_in_a_few_samples() -> None:
    moving = 0.5 / 60.0 * np.arange(1, 60)[:, None] * [1.0, 0.0, 0.0, 0.0]
    true = np.concatenate([np.zeros((240, 4)), moving])
    seen = true + np.random.default_rng(4).normal(0.0, 1e-3, true.shape)
    off = np.abs(_by_noise(seen, 1e-3, (3, 1)) - true)[240:, 0]
    assert off[3:].max() < 4e-3


VIEW = np.eye(3)
SETTINGS = OneEuroParameters(6.0, 120.0, 6.0, jitter=3e-4)


def _filtered(points: Float, sd_m: Float, view: Float = VIEW) -> Float:
    """Points (N, 3) at 60 Hz through the filter, with standard deviations (N, 3) along the axes of the view."""
    machine = PointFilter(SETTINGS, view)
    cov = view.T @ (sd_m[:, :, None] ** 2 * np.eye(3)) @ view
    return np.array(
        [
            machine.push(k * 16_666_667, p[None], c[None])[0]
            for k, (p, c) in enumerate(zip(points, cov, strict=True))
        ]
    )


def test_sure_points_get_the_paper_s_filter() -> None:
    points = np.cumsum(np.random.default_rng(1).normal(0.0, 2e-3, (300, 3)), axis=0)
    plain = OneEuro(SETTINGS)
    expected = np.array([plain.push(k * 16_666_667, p) for k, p in enumerate(points)])
    np.testing.assert_allclose(_filtered(points, np.full((300, 3), 3e-4)), expected, atol=1e-12)


def test_at_rest_no_axis_trembles_more_than_allowed_and_a_quiet_one_is_left_alone() -> None:
    sd = np.tile([3e-4, 3e-4, 3e-3], (4000, 1))
    points = np.random.default_rng(2).normal(0.0, 0.3, (4000, 3)) * sd
    plain = OneEuro(SETTINGS)
    paper = np.array([plain.push(k * 16_666_667, p) for k, p in enumerate(points)])[100:]
    ours = _filtered(points, sd)[100:]
    assert ours[:, 2].std() < 0.5 * paper[:, 2].std()
    np.testing.assert_allclose(ours[:, :2].std(axis=0), paper[:, :2].std(axis=0), rtol=1e-6)


def test_a_moving_point_is_followed_in_depth_within_its_noise_and_sideways_as_before() -> None:
    t = np.arange(240) / 60.0
    sd = np.tile([3e-4, 3e-4, 3e-3], (240, 1))
    for axis in range(3):
        points = np.zeros((240, 3))
        points[:, axis] = 0.5 * t
        behind = (points - _filtered(points, sd))[120:, axis]
        plain = OneEuro(SETTINGS)
        paper = (points - np.array([plain.push(k * 16_666_667, p) for k, p in enumerate(points)]))[120:, axis]
        if axis < 2:
            np.testing.assert_allclose(behind, paper, atol=1e-9)
        assert behind.max() < 3e-3


def test_a_sample_far_less_sure_than_its_neighbours_is_ridden_over() -> None:
    points, sd = np.zeros((200, 3)), np.full((200, 3), 3e-4)
    points[100:102, 2], sd[100:102] = 0.02, 0.03
    assert np.abs(_filtered(points, sd)).max() < 1e-3
    plain = OneEuro(SETTINGS)
    assert np.abs([plain.push(k * 16_666_667, p) for k, p in enumerate(points)]).max() > 0.01


def test_the_axes_are_those_of_the_view() -> None:
    rng = np.random.default_rng(4)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points, sd = np.cumsum(rng.normal(0.0, 1e-3, (100, 3)), axis=0), np.tile([3e-4, 1e-3, 5e-3], (100, 1))
    np.testing.assert_allclose(
        _filtered(points @ rotation, sd, rotation), _filtered(points, sd) @ rotation, atol=1e-9
    )


def test_a_point_without_a_covariance_or_unseen_poisons_nothing() -> None:
    machine = PointFilter(SETTINGS, VIEW)
    cov = np.tile(1e-6 * np.eye(3), (2, 1, 1))
    for k in range(5):
        machine.push(k * 16_666_667, np.ones((2, 3)), cov)
    lost, unsure = np.ones((2, 3)), cov.copy()
    lost[0], unsure[:] = np.nan, np.nan
    out = machine.push(5 * 16_666_667, lost, unsure)
    assert np.isnan(out[0]).all()
    np.testing.assert_allclose(out[1], 1.0)
    np.testing.assert_allclose(machine.push(6 * 16_666_667, np.ones((2, 3)), cov), 1.0)
