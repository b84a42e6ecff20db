"""Every case of `make instructions` within its gate, on the wheels and the QEMU of this day."""

import subprocess
import sys

from tests.aarch64.machine import ROOT, sysroot_or_skip


def test_instructions_per_frame_are_those_of_the_record() -> None:
    sysroot_or_skip()
    counted = subprocess.run(
        [sys.executable, "-m", "bench", "instructions"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert counted.returncode == 0, counted.stdout + counted.stderr
