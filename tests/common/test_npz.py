"""Equal arrays give equal bytes, and a file that is none of ours is an error that names it."""

from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.npz import read_npz, write_npz

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
