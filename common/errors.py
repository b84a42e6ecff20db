"""The one exception tree.

A bad datagram raises nothing: `common.link.datagram` counts it by reason. `ValueError` stays what it is everywhere: the
caller passed something of the wrong shape or range.
"""


class PhalanxError(Exception):
    """Base of every error that a user can cause or fix; its text names thing and fix."""


class CalibrationError(PhalanxError):
    """A calibration file is missing, broken or impossible; the text names the key."""


class RecordingError(PhalanxError):
    """A recording folder is incomplete or unreadable."""


class CameraError(PhalanxError):
    """A camera is gone or refused a setting. Never answered with a fake camera."""


class ImuError(PhalanxError):
    """An IMU is gone, or there is no driver for it. Never answered with a fake IMU."""


class TrackerError(PhalanxError):
    """A self-tracking device is gone, or its system. Never answered with a fake."""


class TrackerChoiceError(TrackerError):
    """Several devices are there and none was selected: waiting does not help."""


class LightsError(PhalanxError):
    """Laser or LEDs cannot be switched, or are on too long. Never answered by fakes."""


class PictureError(PhalanxError):
    """Bytes that are no picture, or of another size; the text goes on behind a name."""


class MessageError(PhalanxError):
    """Bytes that do not decode to one of our messages."""


class BoundsError(MessageError):
    """A message of ours with a number that is beyond what its field can be."""


class BusError(PhalanxError):
    """The bus could not be opened, or a peer did not answer in time."""


class FitError(PhalanxError):
    """The observations do not determine the value, or contradict each other."""
