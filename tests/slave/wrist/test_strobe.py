"""Triples out of disordered streams: never of wrong kinds, never of two poses, and what is counted instead."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.wrist.strobe import RATE_HZ, Delivered, Score, Shown, deliver, recorded, rendered, score
from common.arrays import Image
from common.recording.frame_recording import Illumination
from slave.sources import Frame
from slave.wrist.strobe import Strobe, StrobeCycle, coarse, evidence

RECORDINGS = ("curl", "mcp", "spread", "left_small")
PERIOD_NS = 1e9 / RATE_HZ
A, L, E = range(3)


LIT = 20  # triples


@cache
def all_shown(ambient: str) -> list[Shown]:
    return rendered(ambient, cycles=LIT, seed=5)


def shown(ambient: str = "indoor") -> list[Shown]:
    """The first twelve triples."""
    return all_shown(ambient)[:36]


def frame_of(one: Shown, place: float, seq: int | None = None) -> Frame:
    t_ns = round(place * PERIOD_NS) + 10**15
    return Frame(round(place) if seq is None else seq, t_ns, t_ns, one.image)


def pushed(frames: Sequence[Frame]) -> tuple[list[StrobeCycle], Strobe]:
    strobe = Strobe(RATE_HZ)
    return [cycle for frame in frames if (cycle := strobe.push(frame)) is not None], strobe


def clean(ambient: str = "indoor") -> list[Frame]:
    return [frame_of(one, place) for place, one in enumerate(shown(ambient))]


def seqs(cycles: Sequence[StrobeCycle]) -> list[tuple[int, int, int]]:
    return [(cycle.ambient.seq, cycle.laser.seq, cycle.led.seq) for cycle in cycles]


def pictures(indices: Sequence[int]) -> list[Frame]:
    """These pictures one after another, with times and numbers that tell of nothing."""
    return [frame_of(shown()[index], place) for place, index in enumerate(indices)]


@pytest.mark.parametrize("start", [0, 1, 2])
@pytest.mark.parametrize("ambient", ["dark", "indoor", "bright"])
def test_every_whole_cycle_of_a_clean_stream_comes_through(ambient: str, start: int) -> None:
    cycles, strobe = pushed(clean(ambient)[start:])
    first = 0 if start == 0 else 3
    assert seqs(cycles) == [(k, k + 1, k + 2) for k in range(first, 36, 3)]
    assert strobe.counts["cycles"] == len(cycles)
    assert not any(strobe.counts[event] for event in ("gaps", "out_of_step", "unsure", "unlit"))


def test_labels_are_not_looked_at() -> None:
    wrong = [Frame(f.seq, f.t_ns, f.ready_t_ns, f.image, Illumination.NONE) for f in clean()]
    assert seqs(pushed(wrong)[0]) == seqs(pushed(clean())[0])


@pytest.mark.parametrize("hidden", [False, True])
@pytest.mark.parametrize("ambient", ["dark", "indoor", "bright", "sun"])
def test_frames_dropped_doubled_and_swapped_make_no_wrong_cycle(ambient: str, hidden: bool) -> None:
    found = Score()
    for seed in range(100, 112):
        score(shown(ambient), deliver(36, seed, hidden=hidden), found)
    assert found.frames > 350
    assert found.wrong_illumination == 0
    assert found.mixed == 0
    if ambient != "sun":
        assert found.kept > (0.6 if hidden else 0.99) * found.whole > 0


def test_the_score_sees_a_planted_wrong_cycle() -> None:
    """A label that lies about one frame: the same count would find a strobe that takes it so."""
    spoilt = [one._replace(lit=Illumination.LED) if k == 4 else one for k, one in enumerate(shown())]
    spoilt[6] = spoilt[6]._replace(cycle=9)
    found = Score()
    score(spoilt, [Delivered(k, k) for k in range(36)], found)
    assert (found.wrong_illumination, found.mixed, found.kept) == (1, 1, 10)


@pytest.mark.parametrize("name", RECORDINGS)
def test_recorded_poses_in_and_out_of_order(datasets: Path, name: str) -> None:
    frames = recorded(datasets / "wrist" / name)
    found = Score()
    score(frames, [Delivered(k, k) for k in range(len(frames))], found)
    assert found.kept == len(frames) // 3
    assert min(found.margins) > 0.25
    found = Score()
    for seed in range(8):
        score(frames, deliver(len(frames), seed), found)
    assert (found.wrong_illumination, found.mixed) == (0, 0)
    assert found.kept == found.whole > 0


def test_a_lost_frame_costs_its_cycle_alone() -> None:
    for lost in range(3, 33):
        frames = clean()
        del frames[lost]
        cycles, strobe = pushed(frames)
        assert seqs(cycles) == [(k, k + 1, k + 2) for k in range(0, 36, 3) if k != lost // 3 * 3]
        assert strobe.counts["gaps"] == 1


def test_after_a_slip_that_no_time_shows_the_cycle_is_found_again_within_two_cycles() -> None:
    for lost in range(12, 15):
        cycles, _ = pushed(pictures([k for k in range(36) if k != lost]))
        assert len(cycles) >= 12 - 3
        assert seqs(cycles)[-1] == (32, 33, 34)


def test_copies_are_left_out_wherever_they_stand_in_time() -> None:
    frames = clean()
    stamped_as_the_original = [
        one for f in frames for one in (f, Frame(f.seq, f.t_ns, f.ready_t_ns, f.image.copy()))
    ]
    cycles, strobe = pushed(stamped_as_the_original)
    assert len(cycles) == 12
    assert strobe.counts["doubled"] == 36
    assert len(pushed(pictures([k for k in range(36) for _ in range(2)]))[0]) == 12


def test_pictures_that_were_exchanged_under_their_times_do_not_join_two_poses() -> None:
    """A1 L1 E0 is of the right kinds: only its place in the cycle tells."""
    order = [*range(12), 12, 13, 15, 16, 14, 17, *range(18, 36)]
    cells = [coarse(shown()[index].image) for index in (15, 16, 14)]
    assert evidence(*cells).margin > 0.0
    cycles, strobe = pushed(pictures(order))
    assert (14, 15, 16) not in seqs(cycles)
    assert all(one[0] % 3 == 0 for one in seqs(cycles))
    assert strobe.counts["out_of_step"] > 0


@pytest.mark.parametrize("order", [(A, E, L), (L, A, E), (L, E, A), (E, A, L), (E, L, A)])
def test_another_order_of_the_kinds_gives_nothing_however_regular(order: tuple[int, int, int]) -> None:
    """Of the cyclic shifts whole triples are found; a mirrored strobe has none."""
    cycles, _ = pushed(pictures([3 * pose + kind for pose in range(12) for kind in order]))
    cyclic = order in ((L, E, A), (E, A, L))
    illuminations = [[k % 3 for k in (t.ambient.seq, t.laser.seq, t.led.seq)] for t in cycles]
    assert all([order[k] for k in one] == [A, L, E] for one in illuminations)
    assert bool(cycles) is cyclic


def test_times_that_go_back_or_off_the_beat_join_nothing() -> None:
    back = clean()
    back[4], back[5] = back[5], back[4]
    assert (3, 4, 5) not in seqs(pushed(back)[0])
    late = [
        frame_of(one, place + (0.45 if place % 3 == 1 else 0.0), place) for place, one in enumerate(shown())
    ]
    assert not pushed(late)[0]


def test_a_counter_that_skips_is_a_gap_as_well() -> None:
    frames = [frame_of(one, place, place + (place > 7)) for place, one in enumerate(shown())]
    cycles, strobe = pushed(frames)
    assert strobe.counts["gaps"] == 1
    assert len(cycles) == 11


def test_without_a_hand_nothing_is_sent_and_marked_unlit() -> None:
    """The room alone, with the noise of every frame; then the hand comes back."""
    rng = np.random.default_rng(3)
    room = np.full((480, 640), 40.0)
    room[40:200, 380:600] = 400.0
    noisy = [np.clip(room + rng.normal(0.0, 2.0, room.shape), 0, 255).astype(np.uint8) for _ in range(30)]
    strobe = Strobe(RATE_HZ)
    for place, image in enumerate(noisy):
        assert strobe.push(frame_of(Shown(0, Illumination.AMBIENT, image), place)) is None
    assert strobe.counts["unlit"] == 9  # of ten cycles; of the first nobody knows where it began
    assert strobe.counts["out_of_step"] == strobe.counts["unsure"] == 0
    found = [strobe.push(frame_of(one, 30 + place)) for place, one in enumerate(shown())]
    assert sum(cycle is not None for cycle in found) == 12


def test_black_white_and_random_pictures_are_ordinary_input() -> None:
    rng = np.random.default_rng(8)
    odd = [np.zeros((480, 640), np.uint8), np.full((480, 640), 255, np.uint8)]
    odd += [rng.integers(0, 256, (480, 640), dtype=np.uint8) for _ in range(2)]
    order = rng.integers(0, len(odd), 60).tolist()
    cycles, strobe = pushed([frame_of(Shown(0, Illumination.LED, odd[k]), p) for p, k in enumerate(order)])
    assert not cycles
    assert sum(strobe.counts.values()) > 0


def test_after_a_long_pause_the_cycle_is_not_held_against_the_stream() -> None:
    frames = clean() + [frame_of(one, 10_001 + place) for place, one in enumerate(shown())]
    assert len(pushed(frames)[0]) == 24


@pytest.mark.parametrize("slower", [-0.003, 0.003])
@pytest.mark.parametrize("ambient", ["dark", "indoor", "bright"])
def test_a_real_sensor_of_10_bits_whose_clock_and_black_level_are_not_as_stated(
    ambient: str, slower: float
) -> None:
    """Its clock 0.3 % off and a jitter of 50 us; black 64 of 1023, held from frame to frame within 8 (2 of 255)."""
    rng = np.random.default_rng(11)
    frames: list[Frame] = []
    for k, one in enumerate(shown(ambient)):
        level = 4.0 * one.image + 64.0 - 8.0 + rng.integers(-8, 9) + rng.uniform(0.0, 4.0, one.image.shape)
        image = (np.minimum(level, 1023.0).astype(np.int64) >> 2).astype(np.uint8)
        t_ns = 10**15 + round(k * PERIOD_NS * (1.0 + slower) + rng.normal(0.0, 50e3))
        frames.append(Frame(k, t_ns, t_ns, image, Illumination.NONE))
    assert seqs(pushed(frames)[0]) == seqs(pushed(clean(ambient))[0])
    gap = pushed([*frames[:9], *frames[21:]])[0]  # four triples lost
    assert [one.led.seq for one in gap] == [2, 5, 8, *range(23, 36, 3)]


@pytest.mark.parametrize(
    ("order", "lost"),
    [
        ([12, 14, 13], None),
        ([12, 14, 13], 14),
        ([14, 13, 12], None),
        ([12, 13, 12], None),
        ([12, 12, 13], 13),
    ],
)
def test_leds_that_are_on_in_another_frame_or_in_none_are_out_of_step(
    order: list[int], lost: int | None
) -> None:
    """The fifth cycle shows these pictures; the frame of that place in it does not come."""
    frames = pictures([*range(12), *order, *range(15, 36)])
    cycles, strobe = pushed([frame for frame in frames if frame.seq != lost])
    assert seqs(cycles) == [(k, k + 1, k + 2) for k in range(0, 36, 3) if k != 12]
    assert strobe.counts["out_of_step"] == 1
    assert strobe.counts["unsure"] == strobe.counts["unlit"] == 0


def test_a_hand_that_leaves_is_out_of_step_once_and_then_unlit() -> None:
    images = [one.image for one in shown()] + [shown()[k].image for k in (0, 1) for _ in range(15)]
    noisy = [np.clip(image.astype(int) + k % 2, 0, 255).astype(np.uint8) for k, image in enumerate(images)]
    cycles, strobe = pushed([frame_of(Shown(0, Illumination.NONE, one), k) for k, one in enumerate(noisy)])
    assert len(cycles) == 12
    assert (strobe.counts["out_of_step"], strobe.counts["unlit"]) == (1, 9)


READABLE = (
    "dark",
    "indoor",
    "indoor x 2",
    "indoor x 5",
    "bright",
)  # the sun, and ten times the room, drown the LEDs


@cache
def in_light(name: str) -> list[Image]:
    """The same poses in one light: those of a room, or of an indoor room some times as bright."""
    room, _, times = name.partition(" x ")
    images = [one.image for one in all_shown(room)]
    if not times:
        return images
    own = [image.astype(np.float64) for image in in_light("dark")]
    lit = [dark + float(times) * (image - dark) for dark, image in zip(own, images, strict=True)]
    return [np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in lit]


def under(light: Callable[[int], str]) -> tuple[set[int], Strobe]:
    """Which poses of a stream come through whose frame k is taken in `light(k)`; none may be made of other frames."""
    cycles, strobe = pushed(
        [frame_of(Shown(0, Illumination.NONE, in_light(light(k))[k]), k) for k in range(3 * LIT)]
    )
    found = seqs(cycles)
    assert set(found) <= {(k, k + 1, k + 2) for k in range(0, 3 * LIT, 3)}
    return {first // 3 for first, _, _ in found}, strobe


def in_one_light(light: Callable[[int], str]) -> set[int]:
    """The poses whose three frames are taken in the same light, one that leaves the LEDs to be seen."""
    lights = [{light(3 * pose + kind) for kind in range(3)} for pose in range(LIT)]
    return {pose for pose, seen in enumerate(lights) if len(seen) == 1 and seen <= set(READABLE)}


@pytest.mark.parametrize("every", [1, 3, LIT // 2])
@pytest.mark.parametrize("within", [A, L, E])
@pytest.mark.parametrize(
    "lights",
    [
        ("dark", "indoor"),
        ("dark", "bright"),
        ("indoor", "bright"),
        ("indoor", "indoor x 2"),
        ("indoor", "indoor x 5"),
        ("indoor", "indoor x 10"),
        ("dark", "sun"),
    ],
    ids=" | ".join,
)
@pytest.mark.parametrize("backwards", [False, True])
def test_light_that_is_switched_costs_no_cycle_but_the_one_it_is_switched_in(
    lights: tuple[str, str], within: int, every: int, *, backwards: bool
) -> None:
    """Before frame A, L or E, every so many triples."""
    one, other = reversed(lights) if backwards else lights

    def light(k: int) -> str:
        return one if (k - within) // (3 * every) % 2 == 0 else other

    found, strobe = under(light)
    assert in_one_light(light) <= found
    if within == A and set(lights) <= set(READABLE):
        assert len(found) == LIT
        assert not any(strobe.counts[event] for event in ("gaps", "out_of_step", "unsure", "unlit"))


@pytest.mark.parametrize("seed", range(3))
def test_light_that_is_another_in_every_cycle_costs_none(seed: int) -> None:
    lights = np.random.default_rng(seed).choice(READABLE, LIT).tolist()
    assert len(under(lambda k: lights[k // 3])[0]) == LIT


@pytest.mark.parametrize("seed", range(3))
def test_light_that_is_another_in_any_frame_makes_no_wrong_cycle(seed: int) -> None:
    names = np.random.default_rng(seed).choice([*READABLE, "indoor x 10", "sun"], 3 * LIT).tolist()
    steady = np.random.default_rng(seed + 100).random(LIT) < 0.5

    def light(k: int) -> str:
        return names[k - k % 3] if steady[k // 3] else names[k]

    assert in_one_light(light) <= under(light)[0]


def test_a_cycle_that_slips_under_light_that_is_switched_is_known_anew_within_two_triples() -> None:
    """A frame of the fifth pose is lost, and no time tells of it; the light goes on before every second pose."""
    for lost in range(12, 15):
        order = [k for k in range(3 * LIT) if k != lost]
        images = [in_light("indoor" if k // 3 % 2 == 0 else "dark")[k] for k in order]
        cycles, strobe = pushed(
            [frame_of(Shown(0, Illumination.NONE, one), place) for place, one in enumerate(images)]
        )
        found = [tuple(order[seq] for seq in one) for one in seqs(cycles)]
        assert found == [(k, k + 1, k + 2) for k in range(0, 3 * LIT, 3) if k not in (12, 15)]
        assert strobe.counts["out_of_step"] in (1, 2)  # that triple, and the cycle that ends where none does
