"""The seam between the slave and any IMU: a real or a synthetic one; nothing behind it can tell which."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from common.messages import ImuSample


class ImuSource(Protocol):
    """An IMU. Opened by its constructor."""

    def read(self) -> ImuSample | None:
        """Block until the next sample, or return None at the end of the stream.

        `t_ns` is on the slave's clock and rises, a gap in `seq` is a sample that was left out. `session` is 0:
        whoever sends it fills that in.

        Raises:
            ImuError: The device is gone, or what it says is broken. Never replaced by a fake one.
        """
        ...

    def close(self) -> None:
        """Give the device back. Safe to call twice."""
        ...


@runtime_checkable
class Reporting(Protocol):
    """An IMU that has more to tell than its samples; asked by the thread of the reports."""

    def counts(self) -> Mapping[str, int]:
        """Event -> how often since it was opened."""
        ...

    def metrics(self) -> Mapping[str, float]:
        """Quantity with its unit -> value now."""
        ...
