"""The judge itself: errors, wrong blobs, found shares and honesty of sigma on numbers made by hand."""

import math

import numpy as np

from bench.markers.accuracy import Measurements, honesty, measure, score
from bench.markers.scene import KINDS
from common.arrays import Float, Image
from slave.markers.detector import MarkerDetector


def test_errors_wrong_blobs_and_found_by_hand() -> None:
    truth = np.zeros((5, 2))
    uv = np.array([[0.3, 0.4], [0.0, 0.0], [np.nan, np.nan], [3.5, 0.0], [0.0, 5.0]])
    got = score(uv, truth, np.array([2.0, 2.0, 2.0, 2.0, 6.0]))
    # Right: distances 0.5, 0 and 5 (within the radius of 6); 3.5 px from a cap of 2 px is a wrong blob.
    assert (got.wrong, got.judged) == (1, 5)
    np.testing.assert_allclose(got.found, 0.6)
    np.testing.assert_allclose(got.median_px, 0.5)
    np.testing.assert_allclose(got.rms_px, math.sqrt((0.25 + 25.0) / 6.0))


def test_nothing_found_is_nan_not_perfect() -> None:
    got = score(np.full((3, 2), np.nan), np.zeros((3, 2)), np.ones(3))
    assert np.isnan(got.rms_px)
    assert (got.found, got.wrong) == (0.0, 0)


def measurements(error: Float, sigma: Float) -> Measurements:
    zero = np.zeros_like(error)
    return Measurements(error, error, zero, zero, np.full(len(error), 8.0), sigma)


def test_honest_sigmas_score_95_percent_and_one_and_boasts_do_not() -> None:
    rng = np.random.default_rng(5)
    sigma = rng.uniform(0.02, 0.3, 4000)
    error = rng.standard_normal((4000, 2)) * sigma[:, None]
    within, ratio = honesty(measurements(error, sigma))
    np.testing.assert_allclose((within, ratio), (0.95, 1.0), atol=0.02)
    within, ratio = honesty(measurements(error, sigma / 2.0))
    assert within < 0.7
    np.testing.assert_allclose(ratio, 2.0, atol=0.05)


class Displaced:
    """A detector that is off by a third of a pixel: the judge must see it."""

    def __init__(self, inner: MarkerDetector) -> None:
        self.inner = inner

    def push(self, image: Image, t_ns: int) -> "Displaced.Shifted":
        found = self.inner.push(image, t_ns)
        return Displaced.Shifted(found.uv + np.array([1.0 / 3.0, 0.0]), found.sigma_px)

    def fresh(self, initial_uv: object = None) -> "Displaced":
        return Displaced(self.inner.fresh())

    class Shifted:
        def __init__(self, uv: Float, sigma_px: Float) -> None:
            self.uv, self.sigma_px = uv, sigma_px


def test_a_displaced_detector_is_found_out() -> None:
    kind = KINDS["320x240"]
    detector = MarkerDetector(kind.camera, kind.names)
    right, off = measure(kind, 3, detector=detector), measure(kind, 3, detector=Displaced(detector))
    np.testing.assert_allclose(
        np.nanmean(off.uv - off.truth, axis=0) - np.nanmean(right.uv - right.truth, axis=0),
        (1.0 / 3.0, 0.0),
        atol=1e-9,
    )
    assert score(off.uv, off.truth, off.radius).rms_px > score(right.uv, right.truth, right.radius).rms_px
    assert np.isfinite(right.sigma).all()
