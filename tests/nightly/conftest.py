"""One emulated PC with Debian's full kernel for all tests of drivers; what is measured is kept in out/nightly.json."""

import json
from collections.abc import Iterator

import pytest

from tests.hosts.board import AMD64, BoardRig, switched_on
from tests.hosts.measured import Measured, kept
from tests.hosts.rig import ROOT

RATE_HZ = 10.0  # what an emulated processor draws, copies and looks at
WIDTH_PX, HEIGHT_PX = 320, 180  # the smallest of vivid
PATIENCE_S = 900.0
# A camera of vivid: it is asked for a gain and takes it; exposure and white balance it does not have.
VIVID = "--control gain=100 --allow-missing exposure --allow-missing white_balance --colours fixed"
LOAD = "modprobe vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=0x0"


@pytest.fixture(scope="session")
def measured() -> Iterator[Measured]:
    """Where numbers go."""
    yield from kept(ROOT / "out" / "nightly.json")


@pytest.fixture(scope="session")
def rig(measured: Measured) -> Iterator[BoardRig]:
    """The machine, on, with a camera of the kernel and the slave that a deployment put there, and a master."""
    with switched_on(AMD64, "PC", measured) as one:
        one.board.run(LOAD)
        file = one.calibration / "cameras/left.json"
        camera = json.loads(file.read_text())
        camera |= {"frame_rate_hz": RATE_HZ, "width_px": WIDTH_PX, "height_px": HEIGHT_PX}
        camera["intrinsics"] |= {"cx_px": 0.5 * (WIDTH_PX - 1), "cy_px": 0.5 * (HEIGHT_PX - 1)}
        file.write_text(json.dumps(camera, indent=1))
        one.start_master()
        slow = ("--ready-s", str(PATIENCE_S / 2), "--wait-s", str(PATIENCE_S / 4))
        camera = ("--camera", "left=v4l2:/dev/video0", "--options", f"left={VIVID}")
        ran = one.deploy(*camera, *slow, timeout_s=PATIENCE_S)
        assert ran.code == 0, f"{ran}\n{one.board.journal()}"
        measured("deploy to the PC", ran.seconds)
        yield one
