"""Debian's kernel and the slave's own doctor on QEMU's Raspberry Pi 3B, by that board's device tree."""

from pathlib import Path

from tests.aarch64.machine import sysroot_or_skip
from tests.hosts.measured import Measured
from tests.nightly.raspi import started
from tests.programs import needs


def test_the_doctor_of_a_slave_says_what_the_board_has_and_lacks(tmp_path: Path, measured: Measured) -> None:
    needs("qemu-system-aarch64")
    output, seconds = started(sysroot_or_skip(), tmp_path)
    measured("raspi3b, from power to the doctor's last word", seconds)
    assert "Raspberry Pi 3 Model B" in output
    assert "aarch64 4" in output
    assert "PHALANX-DOCTOR 1" in output, output  # it has neither camera nor master: it says so, and fails
    doctor = output[output.index("PHALANX-DOCTOR") :]
    for name in ("numpy", "cv2", "zenoh"):
        assert name in doctor, doctor
    assert "/dev/video0" in doctor, doctor
