"""What both architectures are given: frames rendered on this machine, and datagrams that it sealed."""

import json
from pathlib import Path

import numpy as np

from tests.aarch64 import frames, scene
from tests.aarch64.report import opened, others, sealed
from tests.slave.wrist.wrist_frames import strobed

CYCLES = 3  # getting into step may take one or two


def write(folder: Path) -> bytes:
    """Fill `folder`; return what the sealed datagrams say."""
    frames.write(folder / frames.SIX, scene.rendered())
    lit = strobed("curl", CYCLES)
    np.savez(
        folder / "wrist.npz",
        images=np.stack([frame.image for frame in lit]),
        t_ns=np.array([frame.t_ns for frame in lit]),
        lit=np.array([str(frame.illumination) for frame in lit]),
    )
    datagrams = sealed(others())
    (folder / "sealed.json").write_text(json.dumps([datagram.hex() for datagram in datagrams]))
    return b"".join(opened(datagrams))
