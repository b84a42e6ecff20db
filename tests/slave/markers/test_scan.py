"""Windows about expected markers show what whole frames show, to the bit; what is lost is found in strips."""

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.markers.accuracy import clicks
from bench.markers.scene import KINDS, MarkerFrame, sequences
from common.arrays import Image
from common.recording.frame_recording import open_recording
from common.sim.light import LightSchedule
from common.sim.render import Renderer
from slave.cameras.replay import read_png
from slave.commands.offline import camera_of
from slave.markers.classify import MAX_CANDIDATES, SCALE, Blob, ColourTable
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.engine import NUMPY, Engine, engine_named
from slave.markers.reloadable import LightAdaptiveDetector, detector_for
from slave.markers.scan import STRIPS, Scanner, merged
from slave.markers.track import Window
from slave.markers.white_balance import Inline
from tests.slave.light_courses import standard_scene
from tests.slave.painted import CENTRES, NAMES, RANGES, Disc, camera, finger, hand, marker_hsv, render

STEP_NS = 16_666_667
ENGINES = ("numpy", "numba") if importlib.util.find_spec("numba") is not None else ("numpy",)
DETECTORS = {name: MarkerDetector(camera(), NAMES, engine=engine_named(name)) for name in ENGINES}
TABLE = ColourTable(list(RANGES.values()))
EMPTY = render([])
NOWHERE: list[tuple[Window, ...]] = [()] * len(NAMES)


def windowed(engine: str = "numpy") -> MarkerDetector:
    detector = DETECTORS[engine].fresh()
    detector.windows_only = True
    return detector


def push_all(detector: MarkerDetector, images: Sequence[Image]) -> list[Detections]:
    return [detector.push(image, k * STEP_NS) for k, image in enumerate(images)]


def seen(found: Detections) -> list[bool]:
    return np.isfinite(found.uv[:, 0]).tolist()


def assert_same(one: Detections, other: Detections) -> int:
    """All that both report is the same to the bit; how many markers that are."""
    both = np.isfinite(one.uv[:, 0]) & np.isfinite(other.uv[:, 0])
    for name in ("uv", "area", "clarity", "sigma_px", "colour"):
        np.testing.assert_array_equal(getattr(one, name)[both], getattr(other, name)[both], name)
    return int(both.sum())


# The same as a scan of the whole frame


@pytest.mark.parametrize(
    ("name", "least"),
    [
        ("static", 72),
        ("translate_8ms", 108),
        ("flex90", 155),
        ("calib_colors", 6),
        ("lights_0_warm", 6),
        ("poses_left", 18),
    ],
)
def test_every_marker_of_a_recording_is_where_whole_frames_show_it(
    datasets: Path, colours: Path, name: str, least: int
) -> None:
    recording = open_recording(datasets / "stereo" / name)
    rig = recording.manifest.marker_rig()
    same: dict[str, int] = dict.fromkeys(ENGINES, 0)
    for side in ("left", "right"):
        model = camera_of(recording, side, colours)
        seeds = recording.manifest.clicks.get(side)
        pairs = {
            engine: [
                detector_for(model, rig.markers, Inline(), seeds, engine_named(engine), rig.free_markers)
                for _ in range(2)
            ]
            for engine in ENGINES
        }
        for k, row in enumerate(recording.frames_of(side)):
            image = read_png(recording.folder / row.file, (model.height_px, model.width_px))
            for engine, pair in pairs.items():
                if k and not recording.manifest.continuous:
                    pair[:] = [detector.fresh() for detector in pair]
                pair[1].plain.windows_only = True
                one, other = (detector.push(image, row.t_ns) for detector in pair)
                same[engine] += assert_same(one, other)
                assert not any(a and not b for a, b in zip(seen(one), seen(other), strict=True))
    assert min(same.values()) >= least


@cache
def drawn(name: str) -> list[list[MarkerFrame]]:
    kind = KINDS[name]
    return [list(frames) for frames in sequences(replace(kind, frames=max(kind.frames, 5)), 3, seed=11)]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", ["finger_end", "blur6", "occluded15", "clutter", "twelve", "320x240"])
def test_generated_markers_are_the_same(name: str, engine: str) -> None:
    kind = KINDS[name]
    first = MarkerDetector(kind.camera, kind.names, engine=engine_named(engine))
    same = frames = 0
    for sequence in drawn(name):
        pair: tuple[MarkerDetector, MarkerDetector] | None = None
        tracked = [False] * len(kind.names)
        always = np.ones(len(kind.names), np.bool_)
        for frame in sequence:
            if pair is None:
                seeds = clicks(kind, frame) if kind.clicked else None
                pair = first.fresh(seeds), first.fresh(seeds)
                pair[1].windows_only = True
            one, other = (detector.push(frame.image, frame.t_ns) for detector in pair)
            assert seen(one) == seen(other)
            same += assert_same(one, other)
            # A marker that was not tracked may be anywhere, and so may its rival, which its quality remembers.
            np.testing.assert_array_equal(one.alt_uv[tracked], other.alt_uv[tracked])
            always &= seen(one)
            np.testing.assert_array_equal(one.quality[always], other.quality[always])
            tracked = seen(one)
            frames += 1
    assert same >= 0.8 * frames * len(kind.names)


def test_the_standard_scene_is_the_same_and_its_light_is_followed_alike() -> None:
    schedule = LightSchedule(((20.0, 4300.0, 1.0), (20.3, 3600.0, 1.2)))
    scene = replace(standard_scene(7), light=schedule)
    markers = scene.rig.markers
    renderer = Renderer(scene, "left")
    whole, windows = (LightAdaptiveDetector(scene.cameras["left"], markers, Inline()) for _ in range(2))
    windows.plain.windows_only = True
    same = 0
    for k in range(30):
        image, t_ns = renderer.render(20.0 + k / 60.0), round(k * 1e9 / 60.0)
        same += assert_same(whole.push(image, t_ns), windows.push(image, t_ns))
        np.testing.assert_array_equal(whole.log_gains, windows.log_gains)
        assert whole.warnings == windows.warnings
    assert same >= 5 * 29
    assert windows.tables == whole.tables > 0


def test_a_rival_in_the_window_is_seen_and_one_beyond_it_is_not() -> None:
    near, far = Disc(marker_hsv(1), 212.0, 125.0, 7.0), Disc(marker_hsv(1), 600.0, 420.0, 7.0)
    for thing, there in ((near, True), (far, False)):
        detector = windowed()
        frames = push_all(detector, [render(hand())] * 2 + [render([*hand(), thing])] * 3)
        assert all(seen(frames[-1]))
        assert math.isfinite(frames[-1].alt_uv[1, 0]) is there
        assert detector.ambiguity.frames["index"] == (3 if there else 0)


# What is lost


def still(u: float, v: float, marker: int = 1) -> Image:
    """The hand, whose index finger's cap lies elsewhere."""
    return render([d for d in hand() if d.hsv != marker_hsv(marker)] + finger(marker, u, v))


@pytest.mark.parametrize("engine", ENGINES)
def test_a_marker_that_jumps_out_of_its_window_is_found_within_as_many_frames_as_there_are_strips(
    engine: str,
) -> None:
    jumped, before = still(420.0, 330.0), render(hand())
    waits: set[int] = set()
    for phase in range(STRIPS + 1):
        detector = windowed(engine)
        without = [
            render([d for d in hand() if d.hsv != marker_hsv(1)])
        ] * phase  # so the strips begin elsewhere
        frames = push_all(detector, [before, *without, before, before, *[jumped] * (STRIPS + 1)])
        after = frames[-STRIPS - 1 :]
        assert all(all(found) for found in (np.delete(seen(f), 1) for f in after)), "the others go on"
        found = [k for k, f in enumerate(after) if seen(f)[1]]
        assert found, f"not within {STRIPS} frames"
        assert found == list(range(found[0], STRIPS + 1)), "once found it stays"
        assert np.hypot(*(after[found[0]].uv[1] - (420.0, 330.0))) < 0.3
        waits.add(found[0])
    assert min(waits) >= 1
    assert max(waits) == STRIPS, "the bound is met: it is not a loose one"


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("v", [8.0, 120.0, 239.0, 240.0, 300.0, 472.0])
def test_when_all_are_lost_a_marker_anywhere_is_found_within_all_strips(v: float, engine: str) -> None:
    detector = windowed(engine)
    single = render([Disc(marker_hsv(1), 320.0, v, 6.0)])
    frames = push_all(detector, [render(hand()), *[EMPTY] * 40, *[single] * STRIPS])
    assert not any(any(seen(f)) for f in frames[1:41])
    assert np.hypot(*(frames[-1].uv[1] - (320.0, v))) < 0.3
    whole = DETECTORS[engine].fresh().push(single, 0)
    np.testing.assert_array_equal(frames[-1].uv[1], whole.uv[1])


def test_a_hand_that_comes_back_is_whole_within_two_rounds_of_the_strips_and_a_mug_is_not_its_marker() -> (
    None
):
    mug = Disc(marker_hsv(1), 560.0, 40.0, 17.0)  # in the first strip: it is seen before the hand
    gone, back = render([mug]), render([*hand(300.0, 300.0), mug])
    frames = push_all(windowed(), [render(hand()), *[gone] * 60, *[back] * (2 * STRIPS + 2)])
    assert all(seen(frames[-1]))
    assert (np.hypot(*(frames[-1].uv - CENTRES - (300.0, 300.0)).T) < 0.3).all()


@pytest.mark.parametrize("rotated", [1.0, -1.0])
def test_a_hand_that_enters_at_the_edge_of_the_frame_is_followed_into_it(rotated: float) -> None:
    us = [-90.0 + 12.0 * k for k in range(30)]
    images = [render(hand(u if rotated > 0 else 639.0 - u)) for u in us]
    whole, frames = push_all(DETECTORS["numpy"].fresh(), images), push_all(windowed(), images)
    for one, other in zip(whole, frames, strict=True):
        near = np.isfinite(one.uv[:, 0]) & np.isfinite(other.uv[:, 0])
        np.testing.assert_allclose(one.uv[near], other.uv[near], atol=0.5)
    assert all(seen(frames[-1]))
    lag = [sum(seen(one)) - sum(seen(other)) for one, other in zip(whole, frames, strict=True)]
    assert max(lag) <= 6
    assert lag[-STRIPS:] == [0] * STRIPS


@pytest.mark.parametrize("engine", ENGINES)
def test_motion_of_several_windows_a_frame_is_followed_by_prediction_or_found_again(engine: str) -> None:
    detector = windowed(engine)
    us, speed = [120.0], 0.0
    while us[-1] < 520.0:  # faster and faster, at last three times the margin in a frame
        speed += 30.0
        us.append(us[-1] + speed)
    for u, found in zip(us, push_all(detector, [render(hand(u)) for u in us]), strict=True):
        assert (np.hypot(*(found.uv - CENTRES - (u, 200.0)).T) < 0.3).all()
    places = [
        (150.0, 150.0),
        (480.0, 380.0),
        (160.0, 390.0),
        (470.0, 140.0),
    ] * 6  # there is nothing to predict
    jumps = push_all(windowed(engine), [render(hand(*place)) for place in places])
    for place, found in zip(places, jumps, strict=True):
        off = np.hypot(*(found.uv - CENTRES - place).T)
        assert not (off > 0.3).any(), "found late, never wrong"
    rest = [render(hand(300.0, 300.0))] * (2 * STRIPS)
    detector = windowed(engine)
    assert all(seen(push_all(detector, [render(hand(*place)) for place in places] + rest)[-1]))


def test_a_marker_of_a_few_pixels_is_found_in_strips_as_on_all_grids() -> None:
    for u in (300.0, 301.0, 302.0, 303.0):
        speck = render([Disc(marker_hsv(1), u, 331.0, 2.6)])
        frames = push_all(windowed(), [EMPTY, *[speck] * STRIPS])
        assert np.hypot(*(frames[-1].uv[1] - (u, 331.0))) < 0.5


def test_a_surface_in_a_markers_colour_is_seen_whole_and_is_not_the_marker() -> None:
    shirt = render(
        [*hand(), Disc(marker_hsv(1), 320.0, 600.0, 330.0)]
    )  # it reaches into windows, and far out of them
    frames = push_all(windowed(), [render(hand())] * 2 + [shirt] * 4)
    whole = push_all(DETECTORS["numpy"].fresh(), [render(hand())] * 2 + [shirt] * 4)
    for one, other in zip(whole, frames, strict=True):
        assert seen(one) == seen(other)
        assert assert_same(one, other) >= 5


# Parts of the frame


def counted(pixels: list[int]) -> Engine:
    """The engine of numpy, which notes how many points it scans."""

    def scan(
        image: Image,
        table: ColourTable,
        bits: Sequence[int],
        step: int,
        dx: int,
        dy: int,
        size: tuple[int, int] | None,
    ) -> tuple[np.ndarray, list[list[Blob]]]:
        codes, blobs = NUMPY.scan_blobs(image, table, bits, step, dx, dy, size)
        pixels.append(codes.size)
        return codes, blobs

    return Engine(scan, NUMPY.measure, NUMPY.prepare)


def test_windows_are_a_part_of_the_frame_and_what_is_lost_costs_a_strip() -> None:
    points: list[int] = []
    detector = MarkerDetector(camera(), NAMES, engine=counted(points))
    detector.windows_only = True
    every = 160 * 120
    push_all(detector, [render(hand())] * 2)
    assert points[0] == every
    assert sum(points[1:]) < 0.3 * every
    lost = render([d for d in hand() if d.hsv != marker_hsv(1)])
    detector.push(lost, 2 * STEP_NS)
    del points[:]
    detector.push(lost, 3 * STEP_NS)
    strip = 4 * every / STRIPS  # twice as fine in both directions
    assert strip <= sum(points) < 0.5 * every + strip


def test_merged_parts_hold_all_and_none_meets_another() -> None:
    rng = np.random.default_rng(3)
    for _ in range(300):
        left, top = rng.integers(0, 60, (2, 8))
        parts = [
            (x, y, x + w, y + h)
            for x, y, w, h in zip(
                left.tolist(), top.tolist(), *rng.integers(0, 14, (2, 8)).tolist(), strict=True
            )
        ]
        apart = merged(parts)
        for x0, y0, x1, y1 in parts:
            inside = [a <= x0 and b <= y0 and c >= x1 and d >= y1 for a, b, c, d in apart]
            assert sum(inside) == 1 or x0 == x1 or y0 == y1
        for i, (x0, y0, x1, y1) in enumerate(apart):
            assert not any(x0 <= c and a <= x1 and y0 <= d and b <= y1 for a, b, c, d in apart[:i])
    assert merged([]) == []


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("step", [SCALE, SCALE // 2])
@pytest.mark.parametrize("shift", [(0, 0), (SCALE // 2 - 1, 1), (1, 0)])
def test_a_part_of_a_scan_is_that_part(engine: str, step: int, shift: tuple[int, int]) -> None:
    image = render(hand(), noise=3.0)
    scan = engine_named(engine).scan_blobs
    every = scan(image, TABLE, TABLE.bits, step, *shift, None)[0].copy()
    for x, y, width, height in ((0, 0, 12, 9), (48, 20, 40, 30), (640 // step - 8, 480 // step - 5, 8, 5)):
        at = x * step + shift[0], y * step + shift[1]
        codes, blobs = scan(image, TABLE, TABLE.bits, step, *at, (height, width))
        np.testing.assert_array_equal(codes, every[y : y + height, x : x + width])
        for m, options in enumerate(blobs):
            points = (codes & TABLE.bits[m]) != 0
            assert (
                sum(blob.area for blob in options) == step**2 * points.sum() or len(options) == MAX_CANDIDATES
            )


@pytest.fixture
def scanner() -> Scanner:
    return Scanner(640, 480, NUMPY)


def test_the_strips_of_one_round_hold_the_whole_frame(scanner: Scanner) -> None:
    places = [(float(u), float(v)) for u in (4, 320, 634) for v in range(4, 480, 17)]
    found: set[tuple[float, float]] = set()
    for place in places:
        image = render([Disc(marker_hsv(1), *place, 5.0)])
        looks = [scanner.around(image, TABLE, NOWHERE, [1]).blobs[1] for _ in range(STRIPS)]
        if any(looks):
            found.add(place)
    assert found == set(places)


def test_only_what_is_lost_is_sought(scanner: Scanner) -> None:
    image = render(hand())
    for _ in range(STRIPS):
        assert scanner.around(image, TABLE, NOWHERE, []).blobs == [[]] * len(NAMES)
