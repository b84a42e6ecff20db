"""Generated sequences: reproducible, inside the picture, apart from each other, with the noise they promise."""

import math
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from bench.markers.published import detect
from bench.markers.scene import (
    CLEAR,
    KINDS,
    STEP_NS,
    camera_file,
    expose,
    frames_of,
    generator,
    make_scene,
    paints,
    sequences,
)
from common.sim.light import bgr_bytes
from slave.markers.classify import in_range


def test_a_sequence_depends_on_seed_and_number_alone() -> None:
    kind = KINDS["320x240"]
    one = [next(iter(frames)) for frames in sequences(kind, 2)]
    two = next(frames_of(kind, generator(kind, 1)))
    np.testing.assert_array_equal(one[1].image, two.image)
    np.testing.assert_array_equal(one[1].uv, two.uv)
    assert not np.array_equal(one[0].uv, one[1].uv)
    assert not np.array_equal(next(frames_of(kind, generator(kind, 1, seed=2))).uv, two.uv)


@pytest.mark.parametrize("name", KINDS)
def test_caps_are_in_the_picture_and_apart(name: str) -> None:
    kind = KINDS[name]
    for k in range(4):
        scene = make_scene(kind, generator(kind, k))
        travel = scene.velocity * (kind.whole_frames + kind.frames - 1)
        for cap in scene.caps:
            for u, v in ((cap.u, cap.v), (cap.u + travel[0], cap.v + travel[1])):
                reach = max(cap.a, cap.b) + 1.0
                assert reach <= u <= kind.size[0] - 1 - reach
                assert reach <= v <= kind.size[1] - 1 - reach
        for i, a in enumerate(scene.caps):
            for b in scene.caps[:i]:
                assert math.hypot(a.u - b.u, a.v - b.v) > max(a.a, a.b) + max(b.a, b.b) + 2.0


def test_paint_of_every_marker_is_where_the_truth_says() -> None:
    for name in ("finger_end", "twentyfour", "320x240"):
        kind = replace(KINDS[name], frames=1)
        frame = next(iter(next(iter(sequences(kind, 1)))))
        hsv = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2HSV), np.uint8)
        ranges = kind.camera.markers or {}
        for marker, (u, v), radius in zip(kind.names, frame.uv, frame.radius, strict=True):
            reach = max(1, int(radius / 2))
            core = hsv[round(v) - reach : round(v) + reach + 1, round(u) - reach : round(u) + reach + 1]
            assert in_range(core, ranges[marker]).mean() > 0.6, marker


def test_only_judged_frames_hide_paint() -> None:
    kind = replace(KINDS["occluded15"], size=(320, 240), whole_frames=2, frames=1)
    first, second, judged = next(iter(sequences(kind, 1)))
    assert not first.judged
    assert not second.judged
    assert judged.judged
    np.testing.assert_array_equal(second.uv, second.whole_uv)
    np.testing.assert_array_equal(judged.visible, 0.85)
    shift = np.hypot(*(judged.uv - judged.whole_uv).T) / judged.radius
    # A disc that loses a segment of 15 % keeps its centroid 0.135 radii off; ellipses 0.85 to 1.3 times as much.
    assert np.all((shift > 0.1) & (shift < 0.18))
    assert [f.t_ns for f in (first, second, judged)] == [0, STEP_NS, 2 * STEP_NS]


def test_noise_at_mid_grey_is_one_and_a_half_to_two_levels_and_doubles() -> None:
    rng = np.random.default_rng(3)
    grey = np.full((200, 200, 3), 0.2159, np.float32)  # sRGB 128
    once, twice = (expose(grey, noise, rng).astype(np.float64) for noise in (1.0, 2.0))
    assert 1.5 < once.std() < 2.0
    np.testing.assert_allclose(twice.std() / once.std(), 2.0, rtol=0.05)
    np.testing.assert_allclose(once.mean(), 128.0, atol=0.5)


@pytest.mark.parametrize("count", [6, 12, 24])
def test_every_paint_lies_in_its_own_range_only(count: int) -> None:
    ranges = camera_file(count, (640, 480)).markers or {}
    for name, colour in paints(count).items():
        pixel = np.array([[bgr_bytes(np.array(colour))]], np.uint8)
        hsv = np.asarray(cv2.cvtColor(pixel, cv2.COLOR_BGR2HSV), np.uint8)
        assert [other for other, r in ranges.items() if in_range(hsv, r).all()] == [name]
    ordered = sorted((r.hsv_low[0], r.hsv_high[0]) for r in ranges.values())
    assert all(low <= high for low, high in ordered), "the published pipeline knows no range that wraps"
    assert all(a[1] < b[0] for a, b in pairwise(ordered))


def test_an_unknown_number_of_paints_is_refused() -> None:
    with pytest.raises(ValueError, match="7 paints"):
        paints(7)


def test_things_on_the_table_have_marker_colours_and_keep_their_distance() -> None:
    kind = KINDS["clutter"]
    laid = 0
    for k in range(6):
        with_things = make_scene(kind, generator(kind, k))
        without = make_scene(replace(kind, objects=0), generator(kind, k))
        different = np.abs(with_things.table - without.table).max(axis=2) > 1e-6
        laid += int(different.sum() > 500)
        v, u = np.nonzero(different)
        for cap in with_things.caps:
            assert not u.size or np.hypot(u - cap.u, v - cap.v).min() > (CLEAR - 0.5) * cap.a
    assert laid >= 5


def test_the_published_pipeline_finds_them() -> None:
    kind = replace(KINDS["finger_end"], frames=1)
    ranges = kind.camera.markers or {}
    for frames in sequences(kind, 2):
        frame = next(iter(frames))
        error = detect(frame.image, [ranges[n] for n in kind.names]) - frame.uv
        assert np.sqrt(np.mean(np.square(error))) < 1.0
