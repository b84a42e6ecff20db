"""The real V4L2 driver in the real service, before a camera of the kernel (vivid): settings, frames, faults.

vivid has no exposure; that the driver writes and reads back is seen by its gain, and that automatics are switched off
by that of its gain.
"""

import time

import pytest

from tests.hosts.board import BoardRig
from tests.hosts.measured import Measured
from tests.nightly.conftest import LOAD, RATE_HZ

WAIT_S = 240.0
UNBIND = "echo vivid.0 > /sys/bus/platform/drivers/vivid/unbind"
BIND = "echo vivid.0 > /sys/bus/platform/drivers/vivid/bind"
READ = """
from pathlib import Path
from slave.cameras.settings import Setting
from slave.cameras.v4l2_abi import KernelDevice
from slave.cameras.v4l2_controls import read_back, read_controls
device = KernelDevice(Path("/dev/video0"))
asked = [Setting(name, (0.0,), 0.0, "", "") for name in ("gain", "gain_automatic")]
print(read_back(device, read_controls(device), asked))
"""


def sends(rig: BoardRig, since: float, within_s: float = WAIT_S) -> float:
    """Time from `since` to the first datagram [s]; fails without one."""
    first = rig.board.tap.wait(rig.board.address, since, within_s)
    assert first is not None, rig.board.journal()
    return first - since


def silent(rig: BoardRig, silence_s: float = 3.0, within_s: float = 60.0) -> None:
    """Wait until nothing has come for a while."""
    until = time.monotonic() + within_s
    while rig.board.tap.times(rig.board.address, time.monotonic() - silence_s):
        assert time.monotonic() < until, f"it goes on sending:\n{rig.board.journal()}"
        time.sleep(0.1)


def test_frames_flow(rig: BoardRig, measured: Measured) -> None:
    sends(rig, time.monotonic())
    rate = rig.board.tap.rate_hz(rig.board.address, 10.0)
    measured("frames of vivid, detected and sent", rate, "Hz")
    assert rate > 0.2 * RATE_HZ
    assert rate < 1.2 * RATE_HZ


def test_settings_are_in_the_camera(rig: BoardRig) -> None:
    output = rig.board.run(f"/opt/phalanx/current/bin/python - <<'END'\n{READ}\nEND")
    assert "'gain': 100" in output, output
    assert "'gain_automatic': 0" in output, output


def test_a_camera_that_is_unplugged_is_opened_again(rig: BoardRig, measured: Measured) -> None:
    sends(rig, time.monotonic())
    pid = rig.board.main_pid()
    rig.board.run(UNBIND)
    silent(rig)
    rig.board.run(BIND)
    measured("camera back, from its plug to the first datagram", sends(rig, time.monotonic()))
    assert rig.board.main_pid() == pid, f"the slave was started again:\n{rig.board.journal()}"


def test_without_its_driver_it_waits_too(rig: BoardRig) -> None:
    sends(rig, time.monotonic())
    rig.board.run(UNBIND)
    silent(rig)
    rig.board.run("modprobe -r vivid")
    assert rig.board.try_run("test -e /dev/video0").returncode != 0
    rig.board.run(LOAD)
    sends(rig, time.monotonic())


@pytest.fixture
def forbidden(rig: BoardRig) -> str:
    """Folder of a drop-in that takes cameras from the devices that the service may open."""
    return f"/etc/systemd/system/{rig.board.unit}.d"


def test_a_service_that_may_not_open_cameras_has_none(rig: BoardRig, forbidden: str) -> None:
    sends(rig, time.monotonic())
    try:
        rule = "[Service]\\nDeviceAllow=\\nDeviceAllow=char-media rw\\n"
        rig.board.run(
            f"mkdir -p {forbidden} && printf '{rule}' > {forbidden}/forbidden.conf && systemctl daemon-reload"
        )
        rig.board.run(f"systemctl restart --no-block {rig.board.unit}")
        silent(rig)
        begin = time.monotonic()
        while "not permitted" not in rig.board.journal() and time.monotonic() < begin + WAIT_S:
            time.sleep(1.0)
        assert "not permitted" in rig.board.journal(), rig.board.journal()
    finally:
        rig.board.run(f"rm -r {forbidden} && systemctl daemon-reload")
        rig.board.run(f"systemctl restart --no-block {rig.board.unit}")
    sends(rig, time.monotonic())
