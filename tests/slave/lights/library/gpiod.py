"""libgpiod 2 for a process of its own: what it sets goes, with its time, into the file PHALANX_FAKE_GPIO.

As much of gpiod/__init__.py and line_request.py of version 2.3 as the driver calls; a file `fails` beside that one
makes the chip vanish.
"""

import errno
import os
import time
from enum import Enum
from pathlib import Path
from types import SimpleNamespace
from typing import Any

LOG = Path(os.environ["PHALANX_FAKE_GPIO"])


class Value(Enum):
    INACTIVE = 0
    ACTIVE = 1


line = SimpleNamespace(
    Value=Value, Direction=SimpleNamespace(OUTPUT="output"), Drive=SimpleNamespace(PUSH_PULL="push_pull")
)


class LineSettings(SimpleNamespace):
    """What is asked of a line."""


class LineRequest:
    """Lines that follow what they are set to."""

    def __init__(self, config: dict[int, Any]) -> None:
        self.fd = os.open(os.devnull, os.O_RDWR)
        self.set_values({place: settings.output_value for place, settings in config.items()})

    def set_values(self, values: dict[int, Value]) -> None:
        if LOG.with_name("fails").exists():
            raise OSError(errno.ENODEV, "No such device")
        self._values = dict(values)
        with LOG.open("a") as file:
            file.write(f"{time.monotonic_ns()} {' '.join(str(one.value) for one in values.values())}\n")

    def get_values(self, places: list[int]) -> list[Value]:
        return [self._values[place] for place in places]

    def release(self) -> None:
        os.close(self.fd)


def request_lines(path: str, config: dict[int, Any], consumer: str) -> LineRequest:
    if path != "/dev/gpiochip0":
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")
    return LineRequest(config)
