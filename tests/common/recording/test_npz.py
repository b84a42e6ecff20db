"""Equal arrays give equal bytes, and a file that is none of ours is an error that names it."""

import os
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.recording import recorded_files
from common.recording.recorded_files import read_npz, write_npz
from tests.common.hostile_npz import MIB, member, write_bomb, write_members

ARRAYS = {
    "t_ns": np.arange(3),
    "uv": np.array([[np.nan, -0.0], [1e-300, 2.0], [3.0, np.inf]]),
    "hand": np.array("right"),
}


def test_what_is_written_comes_back_in_order_and_bit_for_bit(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", ARRAYS)
    found = read_npz(tmp_path / "a.npz")
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        assert found[name].tobytes() == array.tobytes()


def test_equal_arrays_give_equal_bytes(tmp_path: Path) -> None:
    strided = {name: np.array([array, array])[0] for name, array in ARRAYS.items()}
    write_npz(tmp_path / "a.npz", ARRAYS)
    write_npz(tmp_path / "b.npz", strided)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_only_the_names_asked_for_are_read(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", ARRAYS)
    assert list(read_npz(tmp_path / "a.npz", ("uv",))) == ["uv"]
    with pytest.raises(RecordingError, match=r"a\.npz: key 'seq' is missing: make it anew"):
        read_npz(tmp_path / "a.npz", ("uv", "seq"), "make it anew")


@pytest.mark.parametrize("keep", [0, 4, 100, -30])
def test_a_cut_file_is_named(keep: int, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    write_npz(path, ARRAYS)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(RecordingError, match=r"a\.npz: .*make it anew"):
        read_npz(path, fix="make it anew")


def test_pickled_objects_are_neither_written_nor_read(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"[Oo]bject"):
        write_npz(tmp_path / "a.npz", {"x": np.array([{}], dtype=object)})
    assert list(tmp_path.iterdir()) == []
    np.savez(tmp_path / "b.npz", x=np.array([{}], dtype=object))
    with pytest.raises(RecordingError, match=r"b\.npz"):
        read_npz(tmp_path / "b.npz")


def test_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_npz(tmp_path / "none" / "a.npz", ARRAYS)


BEYOND = {
    "a shape of terabytes": (member((10**12,)), "its size does not fit"),
    "a shape beyond numbers": (member((10**30, 10**30)), "its size does not fit"),
    "elements without a byte": (member((10**12,), dtype="|S0"), "its size does not fit"),
    "a side below zero": (member((-1, -1), bytes(8)), "its size does not fit"),
    "fewer bytes than the shape says": (member((3,), bytes(8)), "its size does not fit"),
    "more bytes than the shape says": (member((1,), bytes(16)), "its size does not fit"),
    "a header of brackets": (b"\x93NUMPY\x01\x00\x10\x27" + b"(" * 10_000, "not an .npz"),
    "a header of signs": (b"\x93NUMPY\x01\x00\x10\x27" + b"-" * 9_999 + b"1", "not an .npz"),
    "a header of another version": (b"\x93NUMPY\x03\x00\x01\x00\x00\x00 ", "must be of version"),
    "no header": (b"", "not an .npz"),
}


@pytest.mark.parametrize("name", BEYOND)
def test_an_array_is_as_large_as_its_member_or_refused(name: str, tmp_path: Path) -> None:
    content, words = BEYOND[name]
    path = write_members(tmp_path / "a.npz", t_ns=content)
    with pytest.raises(RecordingError, match=rf"a\.npz: .*{words}"):
        read_npz(path)


@pytest.fixture
def most_bytes(monkeypatch: pytest.MonkeyPatch) -> int:
    """What a small file may unpack to: a sixteenth of the real bound, since a larger bomb takes longer to make."""
    bound = recorded_files.PACKED_BYTES // 16
    monkeypatch.setattr(recorded_files, "PACKED_BYTES", bound)
    return bound


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, most_bytes: int) -> None:
    path = write_bomb(tmp_path / "a.npz", "t_ns", most_bytes // MIB + 1)
    assert path.stat().st_size < MIB
    tracemalloc.start()
    try:
        with pytest.raises(RecordingError, match=rf"\d+ bytes unpacked, at most {most_bytes}"):
            read_npz(path, ("t_ns",))
        assert tracemalloc.get_traced_memory()[1] < 2 * MIB
    finally:
        tracemalloc.stop()


def test_a_bomb_that_nobody_asked_for_costs_nothing(tmp_path: Path, most_bytes: int) -> None:
    path = write_bomb(tmp_path / "a.npz", "other", most_bytes // MIB + 1)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("t_ns.npy", member((1,), bytes(8)))
    assert read_npz(path, ("t_ns",))["t_ns"].tolist() == [0.0]
    assert list(read_npz(path, (), also=("t_ns", "uv"))) == ["t_ns"]


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_methods_that_unpack_without_a_bound_are_refused(method: int, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("t_ns.npy", member((1,), bytes(8)))
    with pytest.raises(RecordingError, match="must be stored or deflated"):
        read_npz(path)


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.npz")
    with pytest.raises(RecordingError, match=r"a\.npz: must be a plain file: make it anew"):
        read_npz(tmp_path / "a.npz", fix="make it anew")
