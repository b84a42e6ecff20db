"""Sees no finger: for the slave of a wrist device whose lens, laser or palm is still being measured."""

from slave.sources import Frame


class NullWristDetector:
    """A detector that never completes a triple."""

    def push(self, frame: Frame) -> None:
        """Nothing, whatever there is."""
        del frame
