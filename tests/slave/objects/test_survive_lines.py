"""Lines of libsurvive: whole, cut anywhere, with junk; which device is ours; and the program's clock on ours."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import TrackerChoiceError
from common.geometry.transforms import quaternion_to_matrix
from slave.objects.survive import LONGEST, Fault, Gone, LineDecoder, Pose, Serial, SurviveDevice, read_line
from tests.slave.objects.recorded import HEAD, pose

MS = 1_000_000


def found(data: bytes) -> list[object]:
    return list(LineDecoder().push(data))


def test_a_recorded_session_says_who_is_there_and_where() -> None:
    output = found(HEAD + pose(8.042091) + b"9.112874 WM0 DISCONNECT\r\n")
    assert output[0] == Serial("WM0", "LHR-1A2B3C4D")
    assert isinstance(output[1], Pose)
    assert output[1].t_s == 8.042091
    assert output[1].position_m == (-0.284080, 0.936063, 0.374069)
    assert output[2:] == [Gone("WM0")]


def test_the_quaternion_has_w_first_and_turns_device_axes_into_those_of_the_system() -> None:
    [one] = found(b"1.5 T20 POSE 1 2 3 0.707107 0 0 0.707107 \r\n")
    assert isinstance(one, Pose)
    rotated = quaternion_to_matrix(np.array(one.orientation_wxyz))
    np.testing.assert_allclose(rotated @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-6)  # a quarter about z
    assert math.isclose(math.hypot(*one.orientation_wxyz), 1.0, rel_tol=1e-12)


@given(st.lists(st.integers(1, 300), max_size=12))
def test_lines_are_the_same_however_the_bytes_come(steps: list[int]) -> None:
    data = HEAD + pose(8.0) + pose(8.01, "T20") + b"8.02 WM0 POSE 1 2\r\n" + pose(8.03)
    decoder, output, begin = LineDecoder(), [], 0
    for step in [*steps, len(data)]:
        output += decoder.push(data[begin : begin + step])
        begin += step
    assert output == found(data)
    assert len(output) == 5


@pytest.mark.parametrize("cut", range(1, len(pose(8.0).split(b"\r\n")[0])))
def test_a_pose_cut_and_run_into_by_the_next_line_is_never_accepted(cut: int) -> None:
    line = pose(8.042091).split(b"\r\n")[0]
    [*before, last] = [one for one in found(line[:cut] + b"\n" + pose(9.0)) if not isinstance(one, Serial)]
    assert isinstance(last, Pose)
    assert last.t_s == 9.0
    whole = line.rstrip()
    for one in before:  # but for the last digits of the last number, which turn it by less than 0.1 degrees
        assert isinstance(one, Fault) or cut >= len(whole) - 3


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b"8.0 WM0 POSE 0.1 0.2 0.3 0.707107 0.0 0.0", Fault.LENGTH),
        (b"8.0 WM0 POSE 0.1 0.2 0.3 0.707107 0.0 0.0 0.707107 8.0 WM0 POSE 0.1", Fault.LENGTH),
        (b"8.0 WM0 POSE 0.1 0.2 0.3 0.707107 0.0 zero 0.707107", Fault.NUMBER),
        (b"8.0 WM0 POSE 0.1 0.2 0.3 0.707107 0.0 0_0 0.707107", Fault.NUMBER),
        (b"8.0 WM0 POSE 0.1 0.2 0.3 0.707107 0.0 \xff 0.707107", Fault.NUMBER),
        (b"nan WM0 POSE 0.1 0.2 0.3 0.707107 0.0 0.0 0.707107", Fault.NUMBER),
        (b"-1.0 WM0 POSE 0.1 0.2 0.3 0.707107 0.0 0.0 0.707107", Fault.NUMBER),
        (b"8.0 WM0 POSE 0.1 0.2 0.3 0.707107 0.0 0.0 0.7", Fault.QUATERNION),
        (b"8.0 WM0 POSE 0.1 0.2 0.3 0.0 0.0 0.0 0.0", Fault.QUATERNION),
        (b"8.0 WM0 POSE 0.1 0.2 inf 1.0 0.0 0.0 0.0", Fault.PLACE),
        (b"8.0 WM0 POSE 1e9 0.2 0.3 1.0 0.0 0.0 0.0", Fault.PLACE),
    ],
)
def test_what_is_wrong_with_a_pose_is_reported(line: bytes, why: Fault) -> None:
    assert read_line(line) is why


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"Info: MPFIT success T20 8.04s",
        b"8.0 WM0-raw-obs EXTERNAL_POSE 1 0 0 1 0 0 0",
        b"7.1 0 LH_POSE 0 0 0 1 0 0 0",
        b"8.0 WM0 CONFIG {no serial}",
        b"8.0 W\xe4M POSE 1 0 0 1 0 0 0",
        b"\x00\x01\x02",
    ],
)
def test_lines_about_other_things_say_nothing(line: bytes) -> None:
    assert read_line(line) is None


def test_hexadecimal_numbers_are_read_and_a_solver_that_failed_is_nowhere() -> None:
    one = read_line(b"0x1.014f8bp+3 WM0 POSE 0x1.8p+0 -0x1p-1 0x0p+0 0x1p+0 0x0p+0 0x0p+0 0x0p+0 \r")
    assert isinstance(one, Pose)
    assert (one.t_s, one.position_m) == (float.fromhex("0x1.014f8bp+3"), (1.5, -0.5, 0.0))
    lost = read_line(b"8.0 WM0 POSE nan nan nan -nan nan nan nan")
    assert isinstance(lost, Pose)
    assert all(math.isnan(value) for value in (*lost.position_m, *lost.orientation_wxyz))


def test_bytes_without_end_are_dropped() -> None:
    decoder = LineDecoder()
    assert list(decoder.push(b"x" * (LONGEST + 1))) == [Fault.OVERRUN]
    assert [type(one) for one in decoder.push(b"\n" + pose(1.0))] == [Pose]


def test_without_a_choice_there_is_one_device_only() -> None:
    device = SurviveDevice("tracker", None)
    assert len(device.push(HEAD + pose(8.0), 0)) == 1
    with pytest.raises(TrackerChoiceError, match=r"WM0 \(serial LHR-1A2B3C4D\), T20.*--serial"):
        device.push(pose(8.1, "T20"), 100 * MS)


@pytest.mark.parametrize("wanted", ["LHR-1A2B3C4D", "WM0"])
def test_a_device_is_chosen_by_serial_number_or_name(wanted: str) -> None:
    device = SurviveDevice("tracker", wanted)
    poses = device.push(HEAD + pose(8.0) + pose(8.05, "T20") + pose(8.1), 100 * MS)
    assert [one.seq for one in poses] == [0, 1]
    assert {one.source for one in poses} == {"tracker"}
    assert device.counts["others"] == 1
    nobody = SurviveDevice("tracker", "LHR-00000000")
    assert nobody.push(HEAD + pose(8.0), 0) == []
    assert nobody.there() == "WM0 (serial LHR-1A2B3C4D)"


def test_stamps_become_our_times_though_lines_come_late_and_in_bunches() -> None:
    rng = np.random.default_rng(3)
    device, off = SurviveDevice("tracker", None), []
    begin_ns, rate = 5_000_000_000_000, 1.0 + 80e-6  # its clock gains 80 ppm
    pending, true_ns = b"", []
    for k in range(6000):
        t_s = 2.0 + 0.01 * k
        pending += pose(t_s * rate)
        true_ns.append(begin_ns + round(1e9 * t_s))
        if rng.random() < 0.2:  # blocks of five, each up to 40 ms late, once in a while not at all
            late_ns = round(1e6 * rng.exponential(8.0))
            poses = device.push(pending, true_ns[-1] + late_ns)
            off += [1e-6 * (one.t_ns - true) for one, true in zip(poses, true_ns, strict=True)]
            pending, true_ns = b"", []
    settled = np.array(off[2000:])
    assert len(off) > 5900
    assert np.abs(settled).max() < 1.5  # ms
    assert np.std(settled) < 0.5


def test_a_wall_clock_that_is_set_back_costs_a_few_poses_and_no_more() -> None:
    device = SurviveDevice("tracker", None)
    before = [device.push(pose(100.0 + 0.01 * k), 10 * MS * k) for k in range(100)]
    after = [device.push(pose(40.0 + 0.01 * k), 10 * MS * (100 + k)) for k in range(100)]
    assert sum(map(len, before)) == 100
    assert sum(map(len, after)) >= 97
    assert device.counts["clock_steps"] == 1
    times = [one.t_ns for poses in [*before, *after] for one in poses]
    assert (np.diff(times) > 0).all()
    assert abs(times[-1] - 10 * MS * 199) < MS
