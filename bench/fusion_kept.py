"""Messages of a scene kept on disk, so that to solve them again costs no rendering; under a name that says of what.

The name carries a digest of everything they hang on: scenes, renderers, detectors, calibration. Old ones stay until
`out/` is emptied.
"""

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Literal, cast

import numpy as np

from bench.fusion_scene import MARKER_RIG, WRIST_RIG, Both, Observed, Shown, Sight
from bench.fusion_shown import shown_of
from bench.fusion_watched import watched
from common.messages import decode, encode
from common.recording.npz import read_npz, write_npz

Mode = Literal["rendered", "quick"]
_ROOT = Path(__file__).parent.parent
_KEPT = _ROOT / "out" / "fusion"
_HANGS_ON = (
    "common/sim/**/*.py",
    "common/hand*.py",
    "common/geometry/camera_model.py",
    "common/imu*.py",
    "common/wrist*.py",
    "slave/markers/*.py",
    "slave/wrist/*.py",
    "bench/fusion_scene.py",
    "bench/fusion_shown.py",
    "bench/fusion_watched.py",
    "calib_json/*/*.json",
)
_MAKE: dict[Mode, Callable[[Both, float], Shown]] = {"rendered": watched, "quick": shown_of}


def observed(
    name: str,
    seconds: float,
    seed: int,
    mode: Mode = "rendered",
    folder: Path = _KEPT,
    rigs: tuple[str, str] = (MARKER_RIG, WRIST_RIG),
) -> Shown:
    """The scene's messages, kept ones where there are; rendered and detected, or made of truth (`fusion_shown`).

    Raises:
        PhalanxError: No such scene.
    """
    both = Both.of(name, seed, rigs=rigs)
    path = folder / f"{name}-{'-'.join(rigs)}-{seconds:g}s-{seed}-{mode}-{_digest()}.npz"
    if path.exists():
        return _read(path, both, seconds)
    made = _MAKE[mode](both, seconds)
    folder.mkdir(parents=True, exist_ok=True)
    _write(path, made)
    return made


def _digest() -> str:
    """Of all files that the messages hang on."""
    files = sorted({path for pattern in _HANGS_ON for path in _ROOT.glob(pattern)})
    parts = (str(path.relative_to(_ROOT)).encode() + b"\0" + path.read_bytes() for path in files)
    return sha256(b"\0".join(parts)).hexdigest()[:12]


def _write(path: Path, made: Shown) -> None:
    coded = [encode(message) for message in made.messages]
    line_of_sight = made.line_of_sight
    cameras = {f"visible_t_s.{name}": times for name, times in line_of_sight.visible_t_s.items()}
    cameras |= {f"visible_px2.{name}": area for name, area in line_of_sight.visible_px2.items()}
    write_npz(
        path,
        {
            "messages": np.frombuffer(b"".join(coded), np.uint8),
            "ends": np.cumsum([len(one) for one in coded]),
            "line_t_s": line_of_sight.line_t_s,
            "line_m": line_of_sight.line_m,
            "tip": line_of_sight.tip,
            **cameras,
        },
    )


def _read(path: Path, both: Both, seconds: float) -> Shown:
    data = read_npz(path)
    coded, ends = np.asarray(data["messages"]).tobytes(), np.asarray(data["ends"]).astype(np.int64).tolist()
    messages = [cast(Observed, decode(coded[a:b])) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
    names = both.markers.rig.cameras
    line_of_sight = Sight(
        {name: data[f"visible_t_s.{name}"] for name in names},
        {name: data[f"visible_px2.{name}"] for name in names},
        data["line_t_s"],
        data["line_m"],
        np.asarray(data["tip"], np.bool_),
    )
    return Shown(both, seconds, messages, line_of_sight)
