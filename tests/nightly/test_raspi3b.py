"""Debian's kernel and the slave's own doctor on QEMU's Raspberry Pi 3B, by that board's device tree."""

import shutil
from pathlib import Path

import pytest

from tests.aarch64.machine import sysroot_or_skip
from tests.hosts.measured import Measured
from tests.nightly.raspi import started


def test_the_doctor_of_a_slave_says_what_the_board_has_and_lacks(tmp_path: Path, told: Measured) -> None:
    if shutil.which("qemu-system-aarch64") is None:
        pytest.skip("missing here: qemu-system-arm (Debian: apt install qemu-system-arm)")
    said, seconds = started(sysroot_or_skip(), tmp_path)
    told("raspi3b, from power to the doctor's last word", seconds)
    assert "Raspberry Pi 3 Model B" in said
    assert "aarch64 4" in said
    assert "PHALANX-DOCTOR 1" in said, said  # it has neither camera nor master: it says so, and fails
    doctor = said[said.index("PHALANX-DOCTOR") :]
    for name in ("numpy", "cv2", "zenoh"):
        assert name in doctor, doctor
    assert "/dev/video0" in doctor, doctor
