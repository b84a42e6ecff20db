"""Detector that sees no finger, for a wrist slave being calibrated.

The wrist device's lens, laser or palm is still being measured.
"""

from slave.sources import Frame


class NullWristDetector:
    """Detector that never completes a strobe cycle."""

    def push(self, frame: Frame) -> None:
        """Nothing, whatever there is."""
        del frame
