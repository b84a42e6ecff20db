"""Truths made to harm, which come with a folder of raw frames from anybody: each reader refuses them by name."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.recording.recorded_files import PACKED_BYTES
from master.calibrate.depth.source import Pairs, by_truth
from master.evaluation.score import load_object_truth, load_truth
from master.evaluation.wrist_score import load_wrist_truth
from tests.common.hostile_npz import MIB, member, write_bomb, write_members
from tests.master.evaluation.test_wrist_score import N, recording, truth, write_truth

SHOWN = np.ones(6, np.bool_)
NONE = np.zeros(0)
PAIRS = Pairs(NONE.astype(np.int64), NONE.astype(np.int64), NONE, NONE, NONE)

# Each reader, and an array that it reads.
READERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "hand": (lambda folder: load_truth(folder, SHOWN), "depth"),
    "wrist": (lambda folder: load_wrist_truth(recording(folder, N), "wrist"), "t_ns"),
    "object": (lambda folder: load_object_truth(folder, "cube"), "t_ref"),
    "depth": (lambda folder: by_truth(recording(folder, N), PAIRS), "depth"),
}


def linked(path: Path, _: str) -> None:
    outside = path.parent.parent / "outside.npz"
    write_members(outside, t_ns=member((1,), bytes(8)))
    path.symlink_to(outside)


ATTACKS: dict[str, tuple[Callable[[Path, str], object], str]] = {
    "link outside": (linked, r"truth\.npz: leads to .*outside the recording's folder"),
    "link to itself": (lambda path, _: path.symlink_to(path.name), "links cannot be followed|cannot read"),
    "link to nothing outside": (
        lambda path, _: path.symlink_to("../none"),
        "outside the recording's folder",
    ),
    "pipe": (lambda path, _: os.mkfifo(path), r"truth\.npz: must be a plain file"),
    "folder": (lambda path, _: path.mkdir(), r"truth\.npz: must be a plain file"),
    "header of terabytes": (
        lambda path, name: write_members(path, **{name: member((10**12,))}),
        r"truth\.npz: not an \.npz: .*its size does not fit",
    ),
    "bomb": (
        lambda path, name: write_bomb(path, name, PACKED_BYTES // MIB + 1),
        rf"truth\.npz: .*bytes unpacked, at most {PACKED_BYTES}",
    ),
    "sparse": (lambda path, _: sparse(path), r"truth\.npz: not an \.npz"),
}


def sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 40)


@pytest.mark.parametrize(
    ("reader", "attack"),
    [
        *(("hand", attack) for attack in ATTACKS),
        *(
            (one, attack)
            for one in READERS
            if one != "hand"
            for attack in ("link outside", "header of terabytes")
        ),
    ],
)
def test_a_hostile_truth_is_refused(reader: str, attack: str, tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    folder.mkdir()
    (read, name), (make, words) = READERS[reader], ATTACKS[attack]
    make(folder / "truth.npz", name)
    with pytest.raises(RecordingError, match=words):
        read(folder)


STRANGE = {
    "words": np.array(["one", "two"]),
    "a single one": np.array(1.0),
    "structures": np.zeros(2, [("a", "<f8"), ("b", "<f8")]),
    "three axes": np.zeros((2, 2, 2)),
}


@pytest.mark.parametrize("strange", STRANGE)
@pytest.mark.parametrize(
    "changed", ["joints", "angles", "paint_centroid", "frac", "t_ref", "depth", "center"]
)
def test_a_hand_whose_arrays_do_not_fit_is_refused(changed: str, strange: str, tmp_path: Path) -> None:
    hand = {
        "t_ref": (2,),
        "joints": (2, 25, 3),
        "angles": (2, 21),
        "paint_centroid": (2, 6, 3),
        "frac": (2, 2, 6),
    }
    sweep = {"depth": (2,), "center": (2, 3), "frac": (2, 2)}
    shapes = sweep if changed in ("depth", "center") else hand
    np.savez(
        tmp_path / "truth.npz",
        **({name: np.zeros(shape) for name, shape in shapes.items()} | {changed: STRANGE[strange]}),  # pyright: ignore[reportArgumentType]
    )
    with pytest.raises(RecordingError, match=r"truth\.npz: not the truth of a marker recording"):
        load_truth(tmp_path, SHOWN)


@pytest.mark.parametrize("strange", STRANGE)
@pytest.mark.parametrize("changed", ["t_ns", "laser_pt", "laser_len_vis", "tip_uv", "joints", "angles"])
def test_a_wrist_whose_arrays_do_not_fit_is_refused(changed: str, strange: str, tmp_path: Path) -> None:
    write_truth(tmp_path, truth(), **({"t_ns": truth().t_ns} | {changed: STRANGE[strange]}))
    with pytest.raises(RecordingError, match=r"truth\.npz: not the truth of the"):
        load_wrist_truth(recording(tmp_path, N), "wrist")


@pytest.mark.parametrize("strange", STRANGE)
def test_an_object_that_does_not_fit_is_refused(strange: str, tmp_path: Path) -> None:
    array = STRANGE[strange]
    np.savez(tmp_path / "truth.npz", t_ref=array, object_cube=np.zeros((2, 4, 4)))
    with pytest.raises(RecordingError, match=r"truth\.npz: object_cube"):
        load_object_truth(tmp_path, "cube")


def test_distances_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "truth.npz", depth=STRANGE["words"])
    with pytest.raises(RecordingError, match=r"truth\.npz: depth"):
        by_truth(recording(tmp_path, 3), PAIRS)
