"""The program that runs on both architectures: what it found, encoded and sealed must be equal, byte for byte.

    python -m tests.aarch64.report FOLDER      prints one line of JSON

FOLDER is made by `tests.aarch64.given`; it also holds `sealed.json`, datagrams that another machine sealed.
"""

import hashlib
import importlib
import json
import pkgutil
import platform
import sys
from pathlib import Path

import cv2
import numpy as np

import common
import slave
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import PhalanxError
from common.link.datagram import Kind, Opener, Sealer, parse
from common.link.handshake import RigKeys
from common.messages import Health, ImuSample, MarkerDetections, Message, WristDetections, decode, encode
from common.recording.frame_recording import Illumination
from slave.markers.detector import MarkerDetector
from slave.sources import Frame
from slave.wrist.detector import WristDetector
from slave.wrist.led_image import WristView
from tests.aarch64.frames import FRAME_NS, SIX, read
from tests.aarch64.guest import Digest, arrays_of

CALIBRATION = Path(__file__).resolve().parents[2] / "calib_json"
KEY = bytes(range(32))
KEY_ID = 0x1122334455667788
MARKER_FRAMES = 8


def absent() -> dict[str, str]:
    """Import every module of slave and common; module -> the library that it lacks."""
    lacking: dict[str, str] = {}
    for package in (common, slave):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if found.name.endswith("__main__"):
                continue
            try:
                importlib.import_module(found.name)
            except ModuleNotFoundError as error:
                lacking[found.name] = str(error.name)
            except PhalanxError as error:  # an engine says how to install what it lacks
                if not isinstance(error.__cause__, ModuleNotFoundError):
                    raise
                lacking[found.name] = str(error.__cause__.name)
    return lacking


def markers(folder: Path) -> list[MarkerDetections]:
    """What is seen of painted markers in rendered frames, as messages."""
    frames = read(folder / SIX)
    detector = MarkerDetector(frames.camera, frames.names)
    messages: list[MarkerDetections] = []
    for k in range(MARKER_FRAMES):
        t_ns = k * FRAME_NS
        found = detector.push(frames.image(k), t_ns)
        measured = (found.uv, found.area, found.quality, found.sigma_px, found.alt_uv)
        messages.append(MarkerDetections(frames.camera.name, 7, k, t_ns, t_ns + 1, *measured))
    return messages


def cycles(folder: Path) -> list[WristDetections]:
    """What a wrist device sees in rendered strobed frames, as messages."""
    rig = load(CALIBRATION / "rigs/wrist.json", RigCalibration)
    camera = load(CALIBRATION / "cameras/wrist.json", CameraCalibration)
    hand = load(CALIBRATION / f"hands/{rig.hand}.json", HandProfile)
    detector = WristDetector(WristView.of(rig, camera, hand), camera.frame_rate_hz)
    with np.load(folder / "wrist.npz") as file:
        images, times, lit = file["images"], file["t_ns"], file["lit"]
    messages: list[WristDetections] = []
    for seq, (image, t_ns, kind) in enumerate(zip(images, times, lit, strict=True)):
        frame = Frame(seq, int(t_ns), int(t_ns) + 4_000_000, image, Illumination(str(kind)), 1000.0)
        if (found := detector.push(frame)) is not None:
            messages.append(found.message("wrist", 7))
    return messages


def others() -> list[Message]:
    """A sample of an IMU, and a report with names, counts and odd floats."""
    quaternion = np.array([0.5, -0.5, 0.5, -0.5])
    sample = ImuSample(
        "imu", 7, 3, -5, np.array([0.1, -0.0, 1e-310]), np.ones(3), np.full(3, np.nan), quaternion
    )
    return [sample, Health("left", 2**63 - 1, 2**60, {"frames": 1}, {"rate_hz": 1 / 3}, "pi-left", "1.2")]


def sealed(messages: list[Message]) -> list[bytes]:
    """Each as a sealed datagram, by keys that are the same everywhere."""
    keys = RigKeys(KEY)
    sealer = Sealer(KEY, keys.rig_tag, KEY_ID)
    return [sealer.seal(Kind.DATA, encode(message)) for message in messages]


def opened(datagrams: list[bytes]) -> list[bytes]:
    """Open, decode and encode again what another machine sealed.

    Raises:
        ValueError: A datagram is refused.
    """
    keys, opener = RigKeys(KEY), Opener(KEY)
    bodies: list[bytes] = []
    for datagram in datagrams:
        header = parse(datagram, keys.rig_tag)
        if isinstance(header, str):
            raise ValueError(f"refused: {header}")
        body = opener.open(header, datagram)
        if isinstance(body, str):
            raise ValueError(f"refused: {body}")
        bodies.append(encode(decode(body.body)))
    return bodies


def _hash(messages: list[MarkerDetections] | list[WristDetections]) -> str:
    digest = Digest()
    for message in messages:
        digest.add(*arrays_of(message))
    return digest.hex()


def report(folder: Path) -> dict[str, object]:
    """All of it; numbers of what was really seen, so that nothing equal can be empty."""
    seen, strobed = markers(folder), cycles(folder)
    messages: list[Message] = [*seen, *strobed, *others()]
    theirs = json.loads((folder / "sealed.json").read_text())
    bodies = opened([bytes.fromhex(one) for one in theirs])
    return {
        "machine": platform.machine(),
        "absent": absent(),
        "markers": _hash(seen),
        "markers_seen": int(sum(np.isfinite(one.uv).all(axis=1).sum() for one in seen)),
        "cycles": _hash(strobed),
        "laser_seen": int(sum(np.isfinite(one.laser_uv).all(axis=1).sum() for one in strobed)),
        "sealed": [one.hex() for one in sealed(messages)],
        "opened": hashlib.sha256(b"".join(bodies)).hexdigest(),
    }


def main(arguments: list[str]) -> int:
    """Print what this machine makes of FOLDER."""
    cv2.setNumThreads(1)
    sys.stdout.write(json.dumps(report(Path(arguments[0]))) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
