"""Folders of raw frames made to harm: each command says why in a line, and reads and writes nothing outside of them."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.commands import command
from tests.common.recording.test_frame_recording import ROWS, camera, rig, write

SECRET = "secret-of-another-folder"
DETECT, REPLAY, JOIN = ("slave", "run"), ("master", "replay"), ("slave", "record")
SOLVE = ("master", "solve")
NO_NAME = r"recording\.json: .* at `\$\.rig\.cameras\[0\]`"


def linked(folder: Path, name: str, target: Path) -> None:
    path = write(folder) / name
    path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(target)


def strange(folder: Path, name: str) -> None:
    """A recording whose camera is called like that."""
    poses = rig(cameras=(name, "right")) | {"T_rig_camera": {}}
    write(folder, rows=(), cameras={name: camera("left"), "right": camera("right")}, rig=poses)


def another(folder: Path, name: str) -> None:
    """A recording with a camera more, which no rig has."""
    write(folder, cameras={one: camera("left") for one in ("left", "right", name)})


def nested(folder: Path, _: Path) -> None:
    (write(folder) / "recording.json").write_text('{"rig": ' + "[" * 200_000)


def sleepless(folder: Path, _: Path) -> None:
    write(folder)
    (folder / "frames.csv").unlink()
    os.mkfifo(folder / "frames.csv")


# The planted file stands in `outside`, and has the secret as its text.
ATTACKS: dict[str, tuple[Callable[[Path, Path], object], dict[tuple[str, str], str]]] = {
    "file outside": (
        lambda folder, _: write(folder, rows=(*ROWS, "left,0,5,none,../outside/secret")),
        {DETECT: r"line 5: file: '\.\./outside/secret' is outside", JOIN: "is outside", SOLVE: "is outside"},
    ),
    "file of NUL": (
        lambda folder, _: write(folder, rows=(*ROWS, "left,0,5,none,left/\0.png")),
        {DETECT: r"line 5: file: 'left/\\x00.png'", REPLAY: r"file: 'left/\\x00.png'"},
    ),
    "link of a frame": (
        lambda folder, outside: linked(folder, "left/0.png", outside / "secret"),
        {DETECT: "left/0.png: leads to .*/outside/secret, outside the recording's folder"},
    ),
    "link of a folder": (
        lambda folder, outside: linked(folder, "left", outside),
        {DETECT: "leads to .*, outside the recording's folder", JOIN: "outside the recording's folder"},
    ),
    "link of the table": (
        lambda folder, outside: linked(folder, "frames.csv", outside / "secret"),
        {DETECT: "frames.csv: leads to", REPLAY: "frames.csv: leads to"},
    ),
    "link of the manifest": (
        lambda folder, outside: linked(folder, "recording.json", outside / "secret"),
        {DETECT: "recording.json: leads to", REPLAY: "recording.json: leads to"},
    ),
    "link to itself": (
        lambda folder, _: linked(folder, "left/0.png", Path("0.png")),
        {DETECT: "its links cannot be followed|cannot read"},
    ),
    "table without end": (
        lambda folder, _: linked(folder, "frames.csv", Path("/dev/zero")),
        {DETECT: "outside the recording's folder"},
    ),
    "camera outside": (
        lambda folder, _: strange(folder, "../../left"),
        {
            REPLAY: NO_NAME,
        },
    ),
    "camera outside, of no rig": (
        lambda folder, _: another(folder, "../../left"),
        {DETECT: r"cameras: '\.\./\.\./left': must be letters", JOIN: r"cameras: '\.\./\.\./left': must be"},
    ),
    "camera of NUL": (
        lambda folder, _: strange(folder, "left\0"),
        {REPLAY: NO_NAME},
    ),
    "camera of NUL, of no rig": (
        lambda folder, _: another(folder, "left\0"),
        {DETECT: r"cameras: 'left\\x00': must be letters", SOLVE: r"cameras: 'left\\x00'"},
    ),
    "camera of dots": (
        lambda folder, _: strange(folder, ".."),
        {JOIN: r"cameras: '\.\.': must be", REPLAY: r"cameras: '\.\.': must be"},
    ),
    "camera of an escape": (
        lambda folder, _: strange(folder, "\x1b[2J"),
        {REPLAY: NO_NAME},
    ),
    "manifest nested": (nested, {REPLAY: "recording.json: ", DETECT: "recording.json"}),
    "time beyond 64 bits": (
        lambda folder, _: write(folder, rows=("left,0,9999999999999999999,none,left/0.png",)),
        {DETECT: "line 2: t_ns"},
    ),
    "number beyond 64 bits": (
        lambda folder, _: write(folder, rows=("left,9999999999999999999,5,none,left/0.png",)),
        {DETECT: "line 2: seq"},
    ),
    "pipe for a table": (sleepless, {DETECT: "frames.csv: must be a plain file"}),
}


@pytest.mark.parametrize(
    ("name", "wanted"),
    [(name, wanted) for name, (_, output) in ATTACKS.items() for wanted in output],
    ids=lambda one: one if isinstance(one, str) else one[1],
)
def test_a_hostile_folder_ends_in_a_line(name: str, wanted: tuple[str, str], tmp_path: Path) -> None:
    folder, outside, out = (tmp_path / one for one in ("recording", "outside", "out"))
    for one in (folder, outside, out):
        one.mkdir()
    (outside / "secret").write_text(SECRET)
    (outside / "0.png").write_text(SECRET)
    make, output = ATTACKS[name]
    make(folder, outside)
    module = wanted[0]
    arguments = {
        DETECT: ["run", "--name", "left", "--camera", f"replay:{folder}", "-o", out / "detections_left.npz"],
        REPLAY: ["replay", folder, "--out", out],
        JOIN: ["record", "--join", folder, folder, "-o", out / "joined"],
        SOLVE: ["replay", folder, "--detections", out, "--out", out],
    }[wanted]
    done = command(module, [str(one) for one in arguments], outside)
    assert done.code == 1, done.text
    assert "Traceback" not in done.text, done.text
    assert SECRET not in done.text
    assert all(one.isprintable() for one in done.text.replace("\n", "")), done.text
    assert re.search(output[wanted], done.text), done.text
    assert not list(out.rglob("*.png")), "a file outside was copied"
    assert {one.name for one in tmp_path.iterdir()} == {"recording", "outside", "out"}, "written elsewhere"
