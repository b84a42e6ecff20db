"""`phalanx-slave` before a camera of the Pi that, as libcamera has it, one program at a time may open.

python -m tests.slave.shared_program LOCK WORD ...        the words of `phalanx-slave`; LOCK: the file that is locked
"""

import fcntl
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from slave.__main__ import main
from tests.slave import fake_picamera2 as fake
from tests.slave.recorded_lists import IMX219


class LockedCamera(fake.Picamera2):
    """The stand-in, in real time, and busy where another process has it."""

    lock = Path()

    def __init__(self, *arguments: Any) -> None:
        self._file = self.lock.open("w")
        try:
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RuntimeError("Camera __init__ sequence did not complete.") from error
        super().__init__(*arguments)

    def capture_request(self, *arguments: Any, **more: Any) -> Any:
        due_ns = self.metadata_of(self._frame)["SensorTimestamp"] + 10_000_000
        time.sleep(max(due_ns - time.monotonic_ns(), 0) * 1e-9)
        return super().capture_request(*arguments, **more)

    def close(self) -> None:
        super().close()
        self._file.close()


if __name__ == "__main__":
    LockedCamera.lock = Path(sys.argv[1])
    fake.install(pytest.MonkeyPatch(), fake.Sensor(modes=IMX219, start_ns=time.monotonic_ns()))
    sys.modules["picamera2"].Picamera2 = LockedCamera  # pyright: ignore[reportAttributeAccessIssue]
    sys.exit(main(sys.argv[2:]))
