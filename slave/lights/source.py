"""The seam between the slave and what switches laser and LEDs: real or synthetic; nothing behind it can tell which."""

from typing import Protocol

from common.frame_recording import Illumination


class Lights(Protocol):
    """Laser and LEDs of a wrist device. Opened dark by its constructor."""

    def switch(self, lit: Illumination) -> None:
        """Have the laser on (`LASER`), the LEDs on (`LED`), or nothing (`AMBIENT`, `NONE`); never both.

        Returns when it is done.

        Raises:
            LightsError: The device is gone, or did not do it. What it does then, nobody knows: `off` is tried next.
        """
        ...

    def off(self) -> None:
        """Have nothing on, now. As `switch`."""
        ...

    def close(self) -> None:
        """Leave it dark and give the device back. Safe to call twice."""
        ...

    def counts(self) -> dict[str, int]:
        """Event of the device -> how often."""
        ...
