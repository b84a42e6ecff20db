"""Messages come back as they went, and bytes that are no message raise `MessageError` and nothing else."""

import random
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from common.arrays import Bool, Float
from common.errors import BoundsError, MessageError
from common.link.datagram import MAX_DATAGRAM, OVERHEAD
from common.messages import (
    FINGER_COUNT,
    JOINT_COUNT,
    MAX_BODY_CHARACTERS,
    MAX_MARKERS,
    MAX_PREVIEW_BYTES,
    MAX_STILL_BYTES,
    MAX_TAGS,
    AnyMessage,
    Backlog,
    CheckItem,
    Checklist,
    Command,
    Contact,
    Gesture,
    HandPose,
    Health,
    ImuSample,
    MarkerDetections,
    Message,
    ObjectPose,
    ObjectSource,
    Preview,
    SolverMode,
    Source,
    Still,
    TagDetections,
    TrackerPose,
    WristDetections,
    decode,
    encode,
    restamped,
)
from common.messages.parts import MAX_TIME_NS, bounds_of, printable

JPEG_HEAD = b"\xff\xd8\xff\xc0\0\x11\x08\0\xf0\x01\x40\x03"  # a frame header of 320 x 240 px
names = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
counts = st.integers(0, 2**63 - 1)
times = st.integers(-MAX_TIME_NS, MAX_TIME_NS)


def positive(draw: st.DrawFn, seen: Bool) -> Float:
    """A sigma where `seen` (M,), NaN elsewhere."""
    sigma = draw(arrays(np.float64, len(seen), elements=st.floats(1e-6, 1e4)))
    return np.where(seen, sigma, np.nan)


def floats(kind: type[Message], field: str, *shape: int) -> st.SearchStrategy[Float]:
    """Any array that the field can be, NaN here and there."""
    return arrays(np.float64, shape, elements=st.just(float("nan")) | st.floats(*bounds_of(kind)[field]))


def rows(kind: type[Message], field: str, *shape: int) -> st.SearchStrategy[Float]:
    """As `floats`, each row NaN in all or not at all."""
    return floats(kind, field, *shape).map(
        lambda array: np.where(np.isnan(array).any(axis=-1, keepdims=True), np.nan, array)
    )


def rotations() -> st.SearchStrategy[Float]:
    """Unit quaternions, and the one that is not known."""
    whole = arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: float(q @ q) > 0.01)
    return st.just(np.full(4, np.nan)) | whole.map(lambda q: q / np.linalg.norm(q))


@st.composite
def detections(draw: st.DrawFn) -> MarkerDetections:
    m = draw(st.integers(0, MAX_MARKERS))
    kind = MarkerDetections
    uv = draw(rows(kind, "uv", m, 2))
    seen = ~np.isnan(uv[:, 0])
    return MarkerDetections(
        camera=draw(names),
        session=draw(counts),
        seq=draw(counts),
        t_ns=draw(times),
        ready_t_ns=draw(times),
        uv=uv,
        area=draw(floats(kind, "area", m)),
        quality=draw(floats(kind, "quality", m)),
        sigma_px=positive(draw, seen),
        alt_uv=np.where(seen[:, None], draw(rows(kind, "alt_uv", m, 2)), np.nan),
        t_sigma_ns=draw(st.floats(0.0, 1e10)),
    )


@st.composite
def cycles(draw: st.DrawFn) -> WristDetections:
    kind, size = WristDetections, FINGER_COUNT
    laser, tip = (draw(rows(kind, name, size, 2)) for name in ("laser_uv", "tip_uv"))
    return WristDetections(
        camera=draw(names),
        session=draw(counts),
        seq=draw(counts),
        t_ns=draw(times),
        ready_t_ns=draw(times),
        laser_uv=laser,
        laser_sigma_px=positive(draw, np.asarray(~np.isnan(laser).any(axis=1))),
        laser_px=draw(floats(kind, "laser_px", size)),
        tip_uv=tip,
        tip_sigma_px=positive(draw, np.asarray(~np.isnan(tip).any(axis=1))),
        tip_depth=draw(floats(kind, "tip_depth", size)),
        t_sigma_ns=draw(st.floats(0.0, 1e10)),
        exposure_us=draw(st.floats(0.0, 1e7)),
    )


@st.composite
def tags(draw: st.DrawFn) -> TagDetections:
    ids = sorted(draw(st.sets(st.integers(0, 65535), max_size=MAX_TAGS)))
    n = len(ids)
    return TagDetections(
        camera=draw(names),
        session=draw(counts),
        seq=draw(counts),
        t_ns=draw(times),
        ready_t_ns=draw(times),
        ids=np.array(ids, np.uint16),
        uv=draw(arrays(np.float64, (n, 4, 2), elements=st.floats(-1e4, 1e4))),
        sigma_px=draw(arrays(np.float64, n, elements=st.floats(1e-6, 1e4))),
        t_sigma_ns=draw(st.floats(0.0, 1e10)),
    )


number_or_nan = st.just(float("nan")) | st.floats(0.0, 1e3)
trackers = st.builds(
    TrackerPose,
    source=names,
    session=counts,
    seq=counts,
    t_ns=times,
    position_m=rows(TrackerPose, "position_m", 3),
    orientation_wxyz=rotations(),
)
objects = st.builds(
    ObjectPose,
    object=names,
    t_ns=times,
    position_m=floats(ObjectPose, "position_m", 3),
    orientation_wxyz=floats(ObjectPose, "orientation_wxyz", 4),
    cov=floats(ObjectPose, "cov", 6, 6),
    residual_m=number_or_nan,
    source=st.sampled_from(list(ObjectSource)).map(int),
    tracked=st.booleans(),
    seen=st.integers(0, MAX_MARKERS),
    expected=st.integers(0, MAX_MARKERS),
    occluded=st.booleans(),
    latency_ns=times,
)
contacts = st.builds(
    Contact,
    hand=names,
    object=names,
    t_ns=times,
    distance_m=floats(Contact, "distance_m", FINGER_COUNT),
    sigma_m=floats(Contact, "sigma_m", FINGER_COUNT),
    point_m=floats(Contact, "point_m", FINGER_COUNT, 3),
    touching=arrays(np.bool_, FINGER_COUNT),
    palm_distance_m=number_or_nan,
    held=st.booleans(),
)
gestures = st.builds(
    Gesture,
    hand=names,
    t_ns=times,
    kind=st.sampled_from(["pose", "pinch", "dial", "tap", "point"]),
    name=names,
    phase=st.sampled_from(["begin", "update", "end"]),
    began_t_ns=times,
    confidence=st.floats(0.0, 1.0),
    distance_m=number_or_nan,
    strength=st.just(float("nan")) | st.floats(0.0, 1.0),
    angle_rad=number_or_nan,
    origin_m=floats(Gesture, "origin_m", 3),
    direction=floats(Gesture, "direction", 3),
)


@st.composite
def hand_poses(draw: st.DrawFn) -> HandPose:
    m, j = draw(st.integers(0, MAX_MARKERS)), JOINT_COUNT
    return HandPose(
        hand=draw(names),
        t_ns=draw(times),
        position_m=draw(floats(HandPose, "position_m", j, 3)),
        orientation_wxyz=draw(floats(HandPose, "orientation_wxyz", j, 4)),
        radius_m=draw(floats(HandPose, "radius_m", j)),
        valid=draw(arrays(np.bool_, j)),
        tracked=draw(arrays(np.bool_, j)),
        cov_m2=draw(floats(HandPose, "cov_m2", j, 3, 3)),
        source=draw(arrays(np.uint8, j, elements=st.sampled_from(list(Source)).map(int))),
        angles_rad=draw(floats(HandPose, "angles_rad", FINGER_COUNT, 4)),
        markers_m=draw(floats(HandPose, "markers_m", m, 3)),
        markers_raw_m=draw(floats(HandPose, "markers_raw_m", m, 3)),
        markers_cov_m2=draw(floats(HandPose, "markers_cov_m2", m, 3, 3)),
        inside_volume=draw(arrays(np.bool_, j)),
        latency_ns=draw(times),
        laser_m=draw(floats(HandPose, "laser_m", FINGER_COUNT, 3)),
        solver_mode=draw(arrays(np.uint8, FINGER_COUNT, elements=st.sampled_from(list(SolverMode)).map(int))),
        ambiguous=draw(arrays(np.bool_, FINGER_COUNT)),
        palm_world_wxyz=draw(floats(HandPose, "palm_world_wxyz", 4)),
        palm_world_sigma_rad=draw(floats(HandPose, "palm_world_sigma_rad", 2)),
        wrist_angles_rad=draw(floats(HandPose, "wrist_angles_rad", 2)),
        wrist_angles_sigma_rad=draw(floats(HandPose, "wrist_angles_sigma_rad", 2)),
    )


imu_samples = st.builds(
    ImuSample,
    source=names,
    session=counts,
    seq=counts,
    t_ns=times,
    gyro_rad_s=rows(ImuSample, "gyro_rad_s", 3),
    accel_m_s2=rows(ImuSample, "accel_m_s2", 3),
    mag_ut=rows(ImuSample, "mag_ut", 3),
    orientation_wxyz=rotations(),
    heading_sigma_rad=st.just(float("nan")) | st.floats(0.0, 10.0),
)
metric_names = st.sampled_from(
    ("rate_hz", "light_red", "colour.index", "palm-imu.clock_offset_us", "control.gain_2")
)
healths = st.builds(
    Health,
    source=names,
    session=counts,
    t_ns=times,
    counts=st.dictionaries(names, counts, max_size=64),
    metrics=st.dictionaries(metric_names, st.floats(-1e18, 1e18), max_size=64),
)
commands = st.builds(Command, target=names, verb=names, body=st.text(max_size=200))
backlogs = st.builds(Backlog, source=names, t_ns=times, skip=st.integers(0, 64))
previews = st.builds(
    Preview, camera=names, t_ns=times, jpeg=st.binary(max_size=200).map(lambda tail: JPEG_HEAD + tail)
)


def sample_pose(markers: int = 6) -> HandPose:
    j = JOINT_COUNT
    return HandPose(
        hand="right",
        t_ns=5,
        position_m=np.zeros((j, 3)),
        orientation_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (j, 1)),
        radius_m=np.full(j, 0.01),
        valid=np.ones(j, dtype=np.bool_),
        tracked=np.zeros(j, dtype=np.bool_),
        cov_m2=np.full((j, 3, 3), np.nan),
        source=np.full(j, Source.SOLVED, dtype=np.uint8),
        angles_rad=np.zeros((FINGER_COUNT, 4)),
        markers_m=np.full((markers, 3), np.nan),
        markers_raw_m=np.full((markers, 3), np.nan),
        markers_cov_m2=np.full((markers, 3, 3), np.nan),
        inside_volume=np.ones(j, dtype=np.bool_),
    )


def sample_detections(markers: int = 6, alternatives: Float | None = None) -> MarkerDetections:
    uv = np.arange(2.0 * markers).reshape(markers, 2)
    uv[1:2] = np.nan
    sigma = np.where(np.isnan(uv[:, 0]), np.nan, 0.1)
    alternative = np.full((markers, 2), np.nan) if alternatives is None else alternatives
    return MarkerDetections(
        "left", 1, 2, 3, 4, uv, np.full(markers, 80.0), np.ones(markers), sigma, alternative
    )


def sample_cycle() -> WristDetections:
    """The little finger's laser and the thumb's tip are not seen."""
    laser, tip = np.arange(10.0).reshape(5, 2), np.arange(20.0, 30.0).reshape(5, 2)
    laser[4], tip[0] = np.nan, np.nan
    seen = [np.where(np.isnan(uv[:, 0]), np.nan, 1.0) for uv in (laser, tip)]
    return WristDetections(
        "wrist", 1, 2, 3, 4, laser, 0.2 * seen[0], 9.0 * seen[0], tip, seen[1], 3.0 * seen[1]
    )


def sample_tags(count: int = 2) -> TagDetections:
    uv = np.arange(8.0 * count).reshape(count, 4, 2)
    return TagDetections("left", 1, 2, 3, 4, np.arange(count, dtype=np.uint16), uv, np.full(count, 0.2))


def sample_object() -> ObjectPose:
    return ObjectPose(
        "wand", 5, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.eye(6), 1e-4, 1, True, 3, 3, False
    )


def sample_contact() -> Contact:
    grip = np.array([True, True, False, False, False])
    return Contact("right", "wand", 5, np.zeros(5), np.ones(5), np.zeros((5, 3)), grip, 0.01, True)


SAMPLES: tuple[Message, ...] = (
    sample_detections(),
    sample_cycle(),
    sample_tags(),
    TrackerPose("tracker", 1, 2, 3, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])),
    sample_object(),
    sample_contact(),
    Gesture("right", 5, "pinch", "index", "begin", 5, 0.9, 0.004, 0.8),
    ImuSample("imu", 1, 2, 3, np.zeros(3), np.ones(3), np.full(3, np.nan), np.array([1.0, 0.0, 0.0, 0.0])),
    sample_pose(),
    Health("left", 1, 2, {"frames": 3}, {"rate_hz": 59.9}, "pi-left", "0.1.0"),
    Checklist("master", 1, 2, (CheckItem("camera_absent", "left", "It is not there.", "Start its slave."),)),
    Command("left", "stop"),
    Backlog("master", 5, 3),
    Preview("left", 2, JPEG_HEAD),
    Still("left", 1, 2, JPEG_HEAD),
)


def assert_same(a: Message, b: Message) -> None:
    assert type(a) is type(b)
    for field in a.__struct_fields__:
        x, y = getattr(a, field), getattr(b, field)
        if isinstance(x, np.ndarray):
            x, y = cast(Float, x), cast(Float, y)
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y, err_msg=field)  # NaN equals NaN here
        else:
            assert x == y or (x != x and y != y), field


def as_map(message: Message) -> dict[str, object]:
    return msgspec.msgpack.decode(encode(message), type=dict[str, object])


EVERY = (
    *(detections(), cycles(), tags(), trackers, imu_samples, hand_poses(), objects, contacts, gestures),
    *(healths, commands, backlogs, previews),
)


@given(st.one_of(EVERY))
def test_round_trip_keeps_every_bit(message: Message) -> None:
    wire = encode(message)
    assert_same(decode(wire), message)
    assert encode(decode(memoryview(wire))) == wire


@pytest.mark.parametrize("message", SAMPLES, ids=lambda m: type(m).__name__)
def test_decoded_arrays_cannot_be_written(message: Message) -> None:
    got = decode(encode(message))
    for field in got.__struct_fields__:
        value = getattr(got, field)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0


def test_a_message_does_not_follow_the_array_it_was_made_of() -> None:
    uv = np.zeros((6, 2))
    message = msgspec.structs.replace(sample_detections(), uv=uv, sigma_px=np.ones(6))
    uv[0] = 7.0
    assert not message.uv.any()


NEEDED = [
    of.name for of in msgspec.structs.fields(HandPose) if of.required and of.name not in ("hand", "t_ns")
]


def parts_of(pose: HandPose, *more: str) -> dict[str, Any]:
    return {name: np.array(getattr(pose, name)) for name in (*NEEDED, *more)}


@pytest.mark.parametrize("markers", [0, 6, MAX_MARKERS])
def test_a_pose_of_good_arrays_is_the_one_that_is_checked_and_holds_them(markers: int) -> None:
    parts = parts_of(sample_pose(markers), "laser_m", "solver_mode")
    pose = HandPose.known_good("right", 5, **parts)
    assert_same(pose, HandPose(hand="right", t_ns=5, **parts))
    assert encode(decode(encode(pose))) == encode(pose)
    for name, array in parts.items():
        assert getattr(pose, name) is array, "nothing is copied"
        assert not array.flags.writeable, "nor written any more"


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("position_m", np.zeros((3, JOINT_COUNT))),
        ("position_m", np.zeros((JOINT_COUNT, 3), np.float32)),
        ("valid", np.ones(JOINT_COUNT, np.uint8)),
        ("markers_raw_m", np.zeros((5, 3))),
        ("solver_mode", np.zeros(5)),
        ("latency", np.zeros(5)),
    ],
)
def test_a_maker_whose_arrays_have_another_shape_or_type_is_stopped(name: str, wrong: Float) -> None:
    with pytest.raises(ValueError, match=f"{name}: .* expected"):
        HandPose.known_good("right", 5, **(parts_of(sample_pose()) | {name: wrong}))


def test_a_maker_who_leaves_an_array_out_is_stopped() -> None:
    parts = parts_of(sample_pose())
    del parts["valid"], parts["cov_m2"]
    with pytest.raises(ValueError, match="missing: cov_m2, valid"):
        HandPose.known_good("right", 5, **parts)


def test_a_marker_frame_fits_one_datagram_and_its_size_is_known() -> None:
    # 6 markers: 6 * (2 + 1 + 1 + 1) * 8 bytes of numbers; names and keys come on top.
    assert 240 < len(encode(sample_detections())) < 390
    largest = sample_detections(
        MAX_MARKERS, np.where(np.arange(MAX_MARKERS)[:, None] == 1, np.nan, [1.0, 2.0])
    )
    assert len(encode(sample_detections(MAX_MARKERS))) < 2100
    assert len(encode(largest)) + OVERHEAD < 2950 < MAX_DATAGRAM


def longest(markers: int) -> MarkerDetections:
    """Detections whose camera name and numbers take the most bytes."""
    return msgspec.structs.replace(
        sample_detections(markers),
        camera="x" * 64,
        session=2**63 - 1,
        seq=2**63 - 1,
        t_ns=-MAX_TIME_NS,
        ready_t_ns=-MAX_TIME_NS,
    )


def test_a_cycle_is_far_below_one_ethernet_packet() -> None:
    longest_cycle = msgspec.structs.replace(
        sample_cycle(),
        camera="x" * 64,
        session=2**63 - 1,
        seq=2**63 - 1,
        t_ns=-MAX_TIME_NS,
        ready_t_ns=-MAX_TIME_NS,
    )
    # 5 * (2 + 1 + 1 + 2 + 1 + 1) * 8 bytes of numbers; names and keys come on top.
    assert 320 < len(encode(sample_cycle())) < len(encode(longest_cycle)) < 640


def test_the_most_tags_are_one_ethernet_packet() -> None:
    most = msgspec.structs.replace(
        sample_tags(MAX_TAGS),
        camera="x" * 64,
        session=2**63 - 1,
        seq=2**63 - 1,
        t_ns=-MAX_TIME_NS,
        ready_t_ns=-MAX_TIME_NS,
    )
    assert len(encode(most)) + OVERHEAD <= 1500 - 20 - 8


def test_the_detections_of_24_markers_are_one_ethernet_packet_while_none_has_a_rival() -> None:
    payload = 1500 - 20 - 8  # MTU less the IPv4 and UDP headers: nothing is split into fragments
    assert len(encode(longest(24))) + OVERHEAD <= payload
    assert len(encode(longest(30))) + OVERHEAD <= payload
    assert len(encode(longest(31))) + OVERHEAD > payload


def test_no_rival_travels_as_no_bytes_and_one_rival_with_its_row() -> None:
    assert as_map(sample_detections())["alt_uv"] == b""
    decoded = decode(encode(sample_detections()))
    assert isinstance(decoded, MarkerDetections)
    assert decoded.alt_uv.shape == (6, 2)
    assert np.isnan(decoded.alt_uv).all()
    alternatives = np.full((6, 2), np.nan)
    alternatives[3] = 7.0, 8.0
    decoded = decode(encode(sample_detections(6, alternatives)))
    assert isinstance(decoded, MarkerDetections)
    np.testing.assert_array_equal(decoded.alt_uv, alternatives)


@pytest.mark.parametrize("value", [np.inf, -np.inf])
def test_infinity_is_refused_on_both_sides(value: float) -> None:
    area = np.array([1.0, value])
    with pytest.raises(ValueError, match=r"area: -?inf is not within"):
        msgspec.structs.replace(sample_detections(2), area=area)
    wire = msgspec.msgpack.encode(as_map(sample_detections(2)) | {"area": area.tobytes()})
    with pytest.raises(MessageError, match=r"area: -?inf is not within"):
        decode(wire)


def test_a_restamped_message_is_another_one_with_the_same_arrays() -> None:
    before = sample_detections(6)
    after = restamped(before, t_ns=before.t_ns + 5, t_sigma_ns=2.0)
    assert after.t_ns == before.t_ns + 5
    assert after.t_sigma_ns == 2.0
    assert after.ready_t_ns == before.ready_t_ns
    assert after.uv is before.uv
    assert encode(restamped(after, t_ns=before.t_ns, t_sigma_ns=before.t_sigma_ns)) == encode(before)


def test_a_message_knows_whether_a_marker_has_a_rival() -> None:
    alternatives = np.full((6, 2), np.nan)
    alternatives[3] = [40.0, 50.0]
    assert sample_detections(6, alternatives).has_alternatives
    none = sample_detections(6)
    assert not none.has_alternatives
    back = decode(encode(none))
    assert isinstance(back, MarkerDetections)
    assert not back.has_alternatives


@pytest.mark.parametrize(
    ("sample", "change"),
    [
        (MarkerDetections, {"camera": ""}),
        (MarkerDetections, {"camera": "a/b"}),
        (MarkerDetections, {"camera": "left\n"}),
        (MarkerDetections, {"camera": "x" * 65}),
        (MarkerDetections, {"seq": -1}),
        (MarkerDetections, {"seq": 2**63}),
        (MarkerDetections, {"seq": 1.0}),
        (MarkerDetections, {"t_ns": 2**63}),
        (MarkerDetections, {"t_ns": None}),
        (MarkerDetections, {"uv": b"\0" * 8 * 11}),
        (MarkerDetections, {"uv": b"\0" * 95}),
        (MarkerDetections, {"uv": [0.0] * 12}),
        (MarkerDetections, {"area": b""}),
        (MarkerDetections, {"area": b"\0" * 8 * (MAX_MARKERS + 1)}),
        (MarkerDetections, {"quality": b"\0" * 8}),
        (MarkerDetections, {"sigma_px": b"\0" * 8}),
        (MarkerDetections, {"sigma_px": b""}),
        (MarkerDetections, {"sigma_px": np.array([0.1, np.nan, 0.1, 0.0, 0.1, 0.1]).tobytes()}),
        (MarkerDetections, {"sigma_px": np.array([0.1, np.nan, 0.1, -0.1, 0.1, 0.1]).tobytes()}),
        (MarkerDetections, {"sigma_px": np.array([0.1, np.nan, 0.1, np.inf, 0.1, 0.1]).tobytes()}),
        (MarkerDetections, {"sigma_px": np.array([0.1, np.nan, 0.1, np.nan, 0.1, 0.1]).tobytes()}),  # seen
        (MarkerDetections, {"sigma_px": np.full(6, 0.1).tobytes()}),  # the second is not seen
        (MarkerDetections, {"alt_uv": b"\0" * 8}),
        (MarkerDetections, {"alt_uv": np.zeros((5, 2)).tobytes()}),
        (MarkerDetections, {"alt_uv": np.zeros((6, 2)).tobytes()}),  # the second is not seen
        (MarkerDetections, {"alt_uv": np.full((6, 2), -np.inf).tobytes()}),
        (MarkerDetections, {"surplus": 1}),
        (MarkerDetections, {"type": "HandPose"}),
        (MarkerDetections, {"type": "Pickle"}),
        (MarkerDetections, {"type": 3}),
        (HandPose, {"position_m": b"\0" * 8}),
        (HandPose, {"valid": b"\2" + b"\0" * (JOINT_COUNT - 1)}),
        (HandPose, {"source": b"\5" * JOINT_COUNT}),
        (HandPose, {"markers_m": b"\0" * 24 * (MAX_MARKERS + 1)}),
        (HandPose, {"markers_raw_m": b""}),
        (Health, {"counts": {"frames": -1}}),
        (Health, {"counts": {f"c{i}": 1 for i in range(513)}}),
        (Health, {"metrics": {"rate_hz": float("nan")}}),
        (Health, {"metrics": {"rate_hz": float("inf")}}),
        (Health, {"metrics": {"a b": 1.0}}),
        (Command, {"verb": ""}),
        (Backlog, {"skip": -1}),
        (Backlog, {"skip": 65}),
        (Preview, {"jpeg": b""}),
        (Preview, {"jpeg": b"GIF89a"}),
        (Preview, {"jpeg": "text"}),
        (Preview, {"jpeg": b"\xff\xd8\xff\xe0jpeg"}),
        (Preview, {"jpeg": JPEG_HEAD + b"\0" * MAX_PREVIEW_BYTES}),
        (Still, {"jpeg": JPEG_HEAD + b"\0" * MAX_STILL_BYTES}),
        (MarkerDetections, {"t_sigma_ns": -1.0}),
        (MarkerDetections, {"t_sigma_ns": float("nan")}),
        (Command, {"body": "x" * (MAX_BODY_CHARACTERS + 1)}),
        (WristDetections, {"laser_uv": b"\0" * 8 * 9}),
        (WristDetections, {"laser_uv": np.full((5, 2), np.nan).tobytes()}),  # four sigmas are left
        (WristDetections, {"laser_uv": np.full((5, 2), np.inf).tobytes()}),
        (WristDetections, {"laser_sigma_px": np.full(5, 0.1).tobytes()}),  # the little finger is not seen
        (WristDetections, {"laser_sigma_px": np.array([0.1, 0.1, 0.0, 0.1, np.nan]).tobytes()}),
        (WristDetections, {"laser_sigma_px": np.array([0.1, 0.1, -0.1, 0.1, np.nan]).tobytes()}),
        (WristDetections, {"laser_px": b""}),
        (WristDetections, {"tip_uv": np.zeros((6, 2)).tobytes()}),
        (WristDetections, {"tip_sigma_px": np.full(5, np.nan).tobytes()}),
        (WristDetections, {"tip_sigma_px": np.full(5, 0.1).tobytes()}),  # the thumb is not seen
        (WristDetections, {"tip_depth": b"\0" * 8}),
        (WristDetections, {"uv": b""}),
        (WristDetections, {"exposure_us": -1.0}),
        (ImuSample, {"heading_sigma_rad": -0.1}),
        (ImuSample, {"heading_sigma_rad": float("inf")}),
        (HandPose, {"laser_m": b"\0" * 8 * 14}),
        (HandPose, {"solver_mode": b"\3\0\0\0\0"}),
        (HandPose, {"ambiguous": b"\0" * 4}),
        (HandPose, {"palm_world_wxyz": b"\0" * 8 * 3}),
        (HandPose, {"palm_world_sigma_rad": np.full(2, np.inf).tobytes()}),
        (TagDetections, {"ids": b"\1"}),
        (TagDetections, {"ids": b"\1\0\1\0"}),  # one twice
        (TagDetections, {"ids": b"\2\0\1\0"}),
        (TagDetections, {"uv": np.full((2, 4, 2), np.nan).tobytes()}),
        (TagDetections, {"uv": np.zeros((2, 4)).tobytes()}),
        (TagDetections, {"sigma_px": np.array([0.1, 0.0]).tobytes()}),
        (TagDetections, {"sigma_px": np.array([0.1, np.nan]).tobytes()}),
        (TagDetections, {"ids": np.arange(17, dtype="<u2").tobytes()}),
        (TrackerPose, {"position_m": b"\0" * 8}),
        (TrackerPose, {"orientation_wxyz": np.full(4, np.inf).tobytes()}),
        (ObjectPose, {"cov": b"\0" * 8 * 35}),
        (ObjectPose, {"source": 5}),
        (ObjectPose, {"residual_m": -0.1}),
        (ObjectPose, {"residual_m": float("inf")}),
        (ObjectPose, {"seen": -1}),
        (ObjectPose, {"tracked": 1}),
        (Contact, {"touching": b"\2\0\0\0\0"}),
        (Contact, {"distance_m": np.full(5, np.inf).tobytes()}),
        (Contact, {"palm_distance_m": float("inf")}),
        (Gesture, {"kind": "wave"}),
        (Gesture, {"phase": "begun"}),
        (Gesture, {"confidence": 1.1}),
        (Gesture, {"confidence": float("nan")}),
        (Gesture, {"distance_m": float("inf")}),
        (Gesture, {"origin_m": b""}),
    ],
)
def test_one_wrong_field_is_refused(sample: type[Message], change: dict[str, object]) -> None:
    content = as_map(next(one for one in SAMPLES if type(one) is sample))
    decode(msgspec.msgpack.encode(content))  # the test is about the change, not about the sample
    with pytest.raises(MessageError):
        decode(msgspec.msgpack.encode(content | change))


BOUNDED = [(type(one), field) for one in SAMPLES for field in bounds_of(type(one))]


@pytest.mark.parametrize(("kind", "field"), BOUNDED, ids=lambda p: p if isinstance(p, str) else p.__name__)
@pytest.mark.parametrize("beyond", [1.01, 1e6, 1e300, np.inf])
def test_a_number_beyond_its_bounds_is_refused_as_such(
    kind: type[Message], field: str, beyond: float
) -> None:
    sample = next(one for one in SAMPLES if type(one) is kind)
    largest = beyond * bounds_of(kind)[field].high  # no field's low is further from zero than its high
    for value in (-largest, largest):
        given = getattr(sample, field)
        wrong = np.nan_to_num(given)
        wrong.flat[0] = value
        content = as_map(sample) | {field: wrong.tobytes() if isinstance(given, np.ndarray) else value}
        with pytest.raises(BoundsError, match=field):
            decode(msgspec.msgpack.encode(content))


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (MarkerDetections, {"t_ns": 2**61 + 1}),
        (MarkerDetections, {"t_sigma_ns": 1e11}),
        (MarkerDetections, {"seq": -1}),
        (WristDetections, {"exposure_us": 1e8}),
        (Backlog, {"skip": 65}),
        (TrackerPose, {"orientation_wxyz": np.array([0.5, 0.0, 0.0, 0.0]).tobytes()}),
        (ImuSample, {"orientation_wxyz": np.zeros(4).tobytes()}),
    ],
)
def test_a_plain_number_and_a_quaternion_have_bounds_too(
    kind: type[Message], change: dict[str, object]
) -> None:
    content = as_map(next(one for one in SAMPLES if type(one) is kind))
    with pytest.raises(BoundsError):
        decode(msgspec.msgpack.encode(content | change))


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        (MarkerDetections, "uv"),
        (WristDetections, "tip_uv"),
        (TrackerPose, "position_m"),
    ],
)
def test_a_point_that_is_known_in_part_is_refused(kind: type[Message], field: str) -> None:
    sample = next(one for one in SAMPLES if type(one) is kind)
    half = np.array(getattr(sample, field))
    half.flat[-1] = np.nan
    with pytest.raises(MessageError, match="NaN in a part of a row"):
        decode(msgspec.msgpack.encode(as_map(sample) | {field: half.tobytes()}))


@pytest.mark.parametrize(
    "text", ["a\x1b[2J", "two\nlines", "last\n", "\x00", "\x9b2J", "\u202eabc", "\u2028"]
)
def test_texts_of_a_device_are_printable(text: str) -> None:
    content = as_map(next(one for one in SAMPLES if isinstance(one, Health)))
    for field in ("host", "version"):
        with pytest.raises(MessageError):
            decode(msgspec.msgpack.encode(content | {field: text}))
    output = decode(encode(Health("left", 1, 2, {}, {}, text, text)))
    assert isinstance(output, Health)
    assert output.host == output.version == printable(text) != text


def test_a_report_can_be_read_whatever_was_counted() -> None:
    counts = {"frames": 2**70, "gone": -5, "x" * 80: 1} | {f"c{i}": i for i in range(600)}
    metrics = {"rate_hz": float("nan"), "away_s": float("inf"), "detect_us": 1e300, "at_rest": -1e300}
    report = decode(encode(Health("left", 1, 2, counts, metrics, "h" * 90)))
    assert isinstance(report, Health)
    assert (report.counts["frames"], report.counts["gone"], report.counts["x" * 64]) == (2**63 - 1, 0, 1)
    assert len(report.counts) == 512
    assert report.metrics == {"detect_us": 1e18, "at_rest": -1e18}


DEFAULTED = {
    *("latency_ns", "laser_m", "solver_mode", "ambiguous", "palm_world_wxyz", "palm_world_sigma_rad"),
    *("wrist_angles_rad", "wrist_angles_sigma_rad"),
    *("heading_sigma_rad", "t_sigma_ns", "exposure_us", "body"),
    *("strength", "angle_rad", "origin_m", "direction"),
    *("host", "version"),
}


@pytest.mark.parametrize("message", SAMPLES, ids=lambda m: type(m).__name__)
def test_a_missing_field_is_refused_unless_it_has_a_default(message: Message) -> None:
    content = as_map(message)
    for field in content:
        wire = msgspec.msgpack.encode({key: value for key, value in content.items() if key != field})
        if field in DEFAULTED or (isinstance(message, Gesture) and field == "distance_m"):
            decode(wire)
            continue
        with pytest.raises(MessageError):
            decode(wire)


@pytest.mark.parametrize("message", SAMPLES, ids=lambda m: type(m).__name__)
def test_cut_and_lengthened_bytes_are_refused(message: Message) -> None:
    wire = encode(message)
    for length in range(len(wire)):
        with pytest.raises(MessageError):
            decode(wire[:length])
    for junk in (b"\0", b"\xc0", wire):
        with pytest.raises(MessageError):
            decode(wire + junk)


@pytest.mark.parametrize(
    "wire",
    [
        b"",
        b"\x80",
        b"\xc1",
        b"\xdd\xff\xff\xff\xff",  # an array that says it has 2^32 elements
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x91" * 100_000,  # nesting beyond the interpreter's stack
        b"\x81\xa4type\xa7Command",
        b"\x82\xa4type\xa7Command\xa6target" + b"\x91" * 100_000,
        b"\x82\xa4type\xa7Command\xa1x" + b"\x81\xa1x" * 100_000,
        b"\x81\xa4type\xc7\x01\x05x",
        b"\x81\xa4type\xa2\xff\xff",
    ],
)
def test_crafted_bytes_are_refused(wire: bytes) -> None:
    with pytest.raises(MessageError):
        decode(wire)


def mutated(rng: random.Random, wire: bytes) -> bytes:
    """One of our messages with some bytes changed, cut out, doubled or replaced by junk."""
    data = bytearray(wire)
    for _ in range(rng.randint(1, 4)):
        i = rng.randrange(len(data) + 1)
        match rng.randrange(5):
            case 0 if i < len(data):
                data[i] = rng.randrange(256)
            case 1:
                del data[i : i + rng.randint(1, 9)]
            case 2:
                data[i:i] = rng.randbytes(rng.randint(1, 9))
            case 3 if i < len(data):
                data[i] ^= 1 << rng.randrange(8)
            case _:
                data[i:i] = data[: rng.randint(1, 16)]
    return bytes(data)


def check_total(data: bytes) -> AnyMessage | None:
    """`decode` returns a message that encodes and decodes to itself, or raises `MessageError`."""
    try:
        message = decode(data)
    except MessageError:
        return None
    assert_same(decode(encode(message)), message)
    return message


def test_thousands_of_random_and_mutated_byte_strings_raise_nothing_else() -> None:
    rng = random.Random(7)
    wires = [encode(message) for message in SAMPLES]
    accepted = 0
    for i in range(20_000):
        data = (
            rng.randbytes(rng.randrange(64)) if i % 4 == 0 else mutated(rng, wires[rng.randrange(len(wires))])
        )
        accepted += check_total(data) is not None
    # Some mutations only change a number: if none were accepted the fuzzer would not reach the inside.
    assert 200 < accepted < 12_000


@given(st.binary(max_size=300))
def test_any_bytes_are_a_message_or_a_message_error(data: bytes) -> None:
    check_total(data)


def test_the_largest_preview_travels_and_one_byte_more_does_not() -> None:
    jpeg = JPEG_HEAD + b"\0" * (MAX_PREVIEW_BYTES - len(JPEG_HEAD))
    assert_same(decode(encode(Preview("left", 1, jpeg))), Preview("left", 1, jpeg))
    with pytest.raises(ValueError, match="jpeg: 262145 bytes"):
        Preview("left", 1, jpeg + b"\0")


def test_constructors_refuse_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="uv: shape"):
        msgspec.structs.replace(sample_detections(), uv=np.zeros((6, 3)))
    with pytest.raises(ValueError, match="sigma_px: 0 is not within"):
        msgspec.structs.replace(sample_detections(), sigma_px=np.zeros(6))
    with pytest.raises(ValueError, match="alt_uv: an alternative to a marker that is not seen"):
        msgspec.structs.replace(sample_detections(), alt_uv=np.ones((6, 2)))
    with pytest.raises(ValueError, match="at most 48"):
        sample_detections(MAX_MARKERS + 1)
    with pytest.raises(ValueError, match="at most 48"):
        sample_pose(MAX_MARKERS + 1)
