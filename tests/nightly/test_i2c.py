"""The real I2C drivers through smbus2 and the kernel: a stub of the kernel keeps registers as a chip does.

The stub answers single registers, by which lights are driven; transfers of whole messages, by which the IMU's FIFO is
read, it refuses: what the driver then says is tested, and its samples are not.
"""

import subprocess
from collections.abc import Iterator

import pytest

from tests.hosts.board import BoardRig
from tests.hosts.rig import ROOT

LIGHTS, IMU = 0x63, 0x6A
ENABLE, LASER, LED, TIMING, DEVICE_ID = 0x01, 0x03, 0x04, 0x08, 0x0C  # LM3644, SNVSA52E, 8.6
FILES = "/root/calib_json"


class Stub:
    """Chips on a bus of the machine."""

    def __init__(self, rig: BoardRig) -> None:
        self.board = rig.board
        names = self.board.run("grep -l 'SMBus stub driver' /sys/bus/i2c/devices/i2c-*/name")
        self.bus = int(names.split("/i2c-")[1].split("/")[0])

    def write(self, register: int, value: int) -> None:
        """Set a register of the lights, as the chip would."""
        self.board.run(f"i2cset -y {self.bus} {LIGHTS:#x} {register:#x} {value:#x}")

    def read(self, register: int) -> int:
        """A register of the lights."""
        return int(self.board.run(f"i2cget -y {self.bus} {LIGHTS:#x} {register:#x}"), 0)

    def slave(self, *words: str) -> "subprocess.CompletedProcess[str]":
        """Run the slave's program as the service has it."""
        line = ["/opt/phalanx/current/bin/phalanx-slave", *words, "--calibration", FILES]
        return self.board.try_run(" ".join(line), 600.0)

    def lights(self, *words: str) -> "subprocess.CompletedProcess[str]":
        """Run `phalanx-slave doctor --lights` on the stub."""
        return self.slave("doctor", "--rig", "wrist", "--lights", f"i2c:{self.bus}:{LIGHTS:#x}", *words)


@pytest.fixture(scope="module")
def stub(rig: BoardRig) -> Iterator[Stub]:
    """Chips whose registers are all zero."""
    rig.board.run(f"modprobe i2c-dev && modprobe i2c-stub chip_addr={LIGHTS:#x},{IMU:#x}")
    with subprocess.Popen(["tar", "-C", str(ROOT), "-c", "calib_json"], stdout=subprocess.PIPE) as packed:
        into = ["ssh", "-F", str(rig.board.folder / "ssh_config"), rig.board.login, "tar -x -C /root"]
        subprocess.run(into, stdin=packed.stdout, check=True, timeout=60.0)
    yield Stub(rig)
    rig.board.run("modprobe -r i2c-stub")


def test_lights_of_another_chip_are_refused(stub: Stub) -> None:
    stub.write(DEVICE_ID, 0x04)
    asked = stub.lights("--off")
    assert asked.returncode == 1
    assert "LM3644TT" in asked.stderr


def test_lights_that_were_left_on_go_dark(stub: Stub) -> None:
    stub.write(DEVICE_ID, 0x02)
    stub.write(ENABLE, 0x0D)  # flash mode with the laser
    asked = stub.lights("--off")
    assert asked.returncode == 0, asked.stderr
    assert stub.read(ENABLE) == 0x00


def test_lights_are_set_up_blink_and_end_dark(stub: Stub) -> None:
    asked = stub.lights("--blink", "0.5")
    assert asked.returncode == 0, asked.stderr
    # 40 mA and 200 mA of the rig: codes of (I - 10.9 mA) / 11.725 mA, rounded down; the shortest time-out.
    assert (stub.read(LASER), stub.read(LED), stub.read(TIMING)) == (2, 16, 0x10)
    assert stub.read(ENABLE) == 0x00
    assert "on" in asked.stdout or "pulse" in asked.stdout, asked.stdout


def test_a_bus_without_whole_messages_is_named_by_the_imu(stub: Stub) -> None:
    words = ("run", "--name", "imu", "--rig", "wrist", "--imu", f"lsm6dsox:{stub.bus}:{IMU:#x}")
    key = "/etc/phalanx/keys/rig.key"
    asked = stub.slave(*words, "--key-file", key)
    assert asked.returncode == 1, asked.stdout + asked.stderr
    assert f"I2C bus {stub.bus}, address {IMU:#x}" in asked.stderr
    assert "not supported" in asked.stderr, asked.stderr


def test_a_bus_that_is_not_there_is_named(stub: Stub) -> None:
    asked = stub.slave("doctor", "--rig", "wrist", "--lights", "i2c:77", "--off")
    assert asked.returncode == 1
    assert "no /dev/i2c-77" in asked.stderr
