"""Instructions per frame: the arithmetic of the marks, the gate, the frames, what is said where a tool is missing.

What needs emulation is skipped, with the reason, where a tool or the network is missing.
"""

import struct
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from slave.markers import detector
from tests.aarch64 import instructions, scene, sysroot
from tests.aarch64.count import FIRST, LAST, Counted, counted, native, slope
from tests.aarch64.frames import FRAME_NS, SIX, WRIST, forth_and_back, read, read_strobed
from tests.aarch64.guest import Digest, Marks, run_case
from tests.aarch64.instructions import CASES, Baseline, BaselineError, main
from tests.aarch64.machine import sysroot_or_skip
from tests.aarch64.sysroot import NotPossibleError, Sysroot

RECORD = Baseline("cortex-a53", {"six": 4_000_000}, {"numpy": "2.4.6", "qemu": "7.2"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("frames")
    scene.write_all(place)
    return place


# The arithmetic of the marks


def test_the_slope_is_per_frame_and_blind_to_what_came_before() -> None:
    assert slope(10**9, 10**9 + 40 * 7_731_615) == 7_731_615 == slope(0, 40 * 7_731_615)


# The record and its gate


@pytest.mark.parametrize(
    ("value", "inside"),
    [(4_000_000, True), (4_039_000, True), (3_961_000, True), (4_041_000, False), (3_959_000, False)],
)
def test_the_gate_is_one_percent_to_either_side(value: int, inside: bool) -> None:
    assert instructions.within(value, RECORD.instructions["six"]) is inside


def test_a_case_without_record_is_outside() -> None:
    assert not instructions.within(4_000_000, RECORD.instructions.get("wrist"))
    assert instructions.compared(4_000_000, None) == "not recorded"


def test_a_record_comes_back_as_written(tmp_path: Path) -> None:
    file = tmp_path / "baseline.json"
    assert instructions.read(file) is None
    instructions.write(RECORD, file)
    assert instructions.read(file) == RECORD


@pytest.mark.parametrize("text", ["", "{}", '{"cpu": "x", "instructions": {"six": "many"}, "versions": {}}'])
def test_a_record_that_is_none_is_refused_by_name(tmp_path: Path, text: str) -> None:
    file = tmp_path / "baseline.json"
    file.write_text(text)
    with pytest.raises(BaselineError, match=r"baseline\.json.*--record"):
        instructions.read(file)


def test_the_record_of_the_project_holds_every_case() -> None:
    record = instructions.read()
    assert record is not None
    assert record.instructions.keys() == CASES.keys()


def test_other_versions_are_named() -> None:
    lines = instructions.other_versions({"numpy": "2.5.0", "cffi": "2.1.1"}, RECORD.versions)
    assert lines == [
        "cffi is 2.1.1, recorded with absent",
        "numpy is 2.5.0, recorded with 2.4.6",
        "qemu is absent, recorded with 7.2",
    ]


# The frames


def test_forth_and_back_never_jumps_and_repeats() -> None:
    walk = [forth_and_back(k, 11) for k in range(41)]
    assert set(walk) == set(range(11))
    assert {abs(b - a) for a, b in pairwise(walk)} == {1}
    assert walk[:20] == walk[20:40]


def test_the_slope_is_taken_over_whole_periods() -> None:
    assert (LAST - FIRST) % (2 * (scene.COUNT - 1)) == 0


def test_frames_come_back_as_written(folder: Path) -> None:
    one, back = scene.rendered(), read(folder / SIX)
    assert (back.camera, back.names) == (one.camera, one.names)
    np.testing.assert_array_equal(back.images, one.images)


def test_strobed_frames_come_back_as_written(folder: Path) -> None:
    one, back = scene.strobed(), read_strobed(folder / WRIST)
    assert (back.rig, back.camera, back.hand) == (one.rig, one.camera, one.hand)
    np.testing.assert_array_equal(back.images, one.images)


@pytest.mark.parametrize("reader", [read, read_strobed])
def test_no_frames_are_an_error(reader: Callable[[Path], object], tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no frames"):
        reader(tmp_path)


def test_every_marker_is_there_to_be_detected(folder: Path) -> None:
    frames = read(folder / SIX)
    machine = detector.MarkerDetector(frames.camera, frames.names)
    found = [machine.push(frames.image(k), k * FRAME_NS) for k in range(5)]
    assert np.isfinite(found[-1].uv).all()


# The program that is counted, natively


@pytest.mark.parametrize("case", ["six", "wrist"])
def test_a_case_marks_twice_and_repeats_bit_by_bit(case: str, folder: Path) -> None:
    marks = Marks()
    assert run_case(case, folder, marks) == run_case(case, folder, Marks())
    assert marks.labels == [f"{case} {FIRST}", f"{case} {LAST}"]


def test_windows_find_what_whole_frames_do(folder: Path) -> None:
    assert run_case("windows", folder, Marks()) == run_case("six", folder, Marks())


def test_an_unknown_case_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="no case 'seven'"):
        run_case("seven", folder, Marks())


def test_one_bit_changes_the_hash_and_the_kind_of_nan_does_not() -> None:
    def digest(*values: float) -> str:
        taken = Digest()
        taken.add(np.array(values))
        return taken.hex()

    assert digest(1.0, np.nan) == digest(1.0, -np.nan)
    assert digest(1.0, np.nan) != digest(np.nextafter(1.0, 2.0), np.nan)


# What it is made of


def test_a_missing_tool_is_named_with_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["six"]) == 2
    output = capsys.readouterr().err
    assert "apt install" in output
    for package in ("mmdebstrap", "gcc", "tar"):
        assert package in output


@pytest.mark.parametrize("arguments", [["seven"], ["six", "--record"]])
def test_wrong_arguments_are_refused(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as refused:
        main(arguments)
    assert refused.value.code == 2


def test_every_wheel_is_pinned() -> None:
    names = [*sysroot.WHEELS, *sysroot.WHEELS_OF_WHEELS, *sysroot.FAST]
    assert len(sysroot._pins(names)) == len(names)


def test_what_is_cached_is_made_once_and_anew_for_other_inputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sysroot, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(sysroot, "ROOT", tmp_path)
    made: list[str] = []

    def make(content: str) -> Callable[[Path], None]:
        def write_it(place: Path) -> None:
            made.append(content)
            (place / "it").write_text(content)

        return write_it

    first = sysroot._made("it", "inputs 1", make("a"), made.append)
    assert sysroot._made("it", "inputs 1", make("b"), made.append) == first
    other = sysroot._made("it", "inputs 2", make("c"), made.append)
    assert ((first / "it").read_text(), (other / "it").read_text()) == ("a", "c")
    assert [entry for entry in made if len(entry) == 1] == ["a", "c"]


def test_what_failed_to_be_made_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sysroot, "CACHE", tmp_path)
    monkeypatch.setattr(sysroot, "ROOT", tmp_path)

    def fail(place: Path) -> None:
        (place / "half").touch()
        raise NotPossibleError("no network")

    with pytest.raises(NotPossibleError, match="no network"):
        sysroot._made("it", "inputs", fail, lambda line: None)
    assert list(tmp_path.iterdir()) == []


# Under emulation


@pytest.fixture(scope="module")
def emulated() -> Sysroot:
    return sysroot_or_skip()


LOOPS = 1000
MACHINE_CODE = (
    0xD2800009 | LOOPS << 5,  # mov x9, LOOPS
    0xF1000529,  # subs x9, x9, 1
    0x54FFFFE1,  # b.ne to the line before
    0xD2800FA8,  # mov x8, 125: sched_get_priority_max
    0xD2800020,  # mov x0, 1
    0xD4000001,  # svc 0
    0xD2800020,  # mov x0, 1
    0xD4000001,  # svc 0
    0xD2800BA8,  # mov x8, 93: exit
    0xD2800000,  # mov x0, 0
    0xD4000001,  # svc 0
)


def program(code: tuple[int, ...]) -> bytes:
    """An ELF file of nothing but `code`, for aarch64 Linux."""
    at, headers = 0x400000, 64 + 56
    size = headers + 4 * len(code)
    ident = b"\x7fELF\x02\x01\x01" + bytes(9)
    header = struct.pack("<16sHHIQQQIHHHHHH", ident, 2, 183, 1, at + headers, 64, 0, 0, 64, 56, 1, 0, 0, 0)
    segment = struct.pack("<IIQQQQQQ", 1, 5, 0, at, at, size, size, 0x1000)
    return header + segment + struct.pack(f"<{len(code)}I", *code)


def test_a_program_of_known_length_is_counted_to_the_instruction(emulated: Sysroot, tmp_path: Path) -> None:
    file, marks = tmp_path / "program", tmp_path / "marks"
    file.write_bytes(program(MACHINE_CODE))
    file.chmod(0o755)
    subprocess.run([*emulated.qemu, "-plugin", f"file={emulated.plugin},to={marks}", str(file)], check=True)
    first = 1 + 2 * LOOPS + 3
    assert [int(line) for line in marks.read_text().split()] == [first, first + 2]


def test_the_plugin_says_what_it_needs(emulated: Sysroot, tmp_path: Path) -> None:
    file = tmp_path / "program"
    file.write_bytes(program(MACHINE_CODE))
    file.chmod(0o755)
    command = [*emulated.qemu, "-plugin", f"file={emulated.plugin}", str(file)]
    output = subprocess.run(command, capture_output=True, text=True)
    assert output.returncode != 0
    assert "to=FILE" in output.stderr


@pytest.fixture(scope="module")
def six(emulated: Sysroot, folder: Path) -> Counted:
    return counted(emulated, folder, ["six"])


def test_a_frame_of_six_markers_takes_the_instructions_of_the_record(six: Counted, emulated: Sysroot) -> None:
    record = instructions.read()
    assert record is not None
    assert six.per_frame["six"] > 640 * 480 / 4  # a scan of a quarter of the pixels cannot take fewer
    differences = instructions.compared(six.per_frame["six"], record.instructions["six"])
    others = instructions.other_versions(emulated.versions, record.versions)
    assert instructions.within(six.per_frame["six"], record.instructions["six"]), (differences, others)


def test_detections_on_aarch64_are_those_of_this_machine_bit_by_bit(six: Counted, folder: Path) -> None:
    if sys.version_info[:2] != (3, 11):
        pytest.skip("Python 3.12 and later add floats otherwise than the emulated 3.11")
    assert six.hashes == native(folder, ["six"])
