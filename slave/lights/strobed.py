"""Camera whose frames are lit by a strobe.

Every frame's stamp goes to the controller on its way to the detector.
"""

from msgspec.structs import replace

from common.calibration import CameraCalibration, RigCalibration
from common.calibration.strobe import StrobeCalibration
from common.errors import CalibrationError, CameraError
from slave.lights.controller import Strobe
from slave.lights.schedule import CYCLE, MARGIN_NS, StrobeSchedule
from slave.sources import Frame, FrameSource, Tunable


class StrobedCamera:
    """A `FrameSource` around another, whose frames are lit by a strobe.

    It is `Tunable` where the inner one is. Closes camera and lights. Holds the exposure limit.
    """

    def __init__(
        self, source: FrameSource, camera: CameraCalibration, rig: RigCalibration, controller: Strobe
    ) -> None:
        """Begin dark; light comes once the stamps are understood.

        Args:
            source: The camera, open.
            camera: Its file, which `check_pulses` let pass.
            rig: With `strobe`.
            controller: Made with `schedule_of` these.
        """
        self._source, self._camera, self._rig = source, camera, rig
        self._controller = controller

    def read(self) -> Frame | None:
        """Next frame of the camera; dark at once where there is none."""
        try:
            frame = self._source.read()
        except Exception:
            self._controller.stalled()
            raise
        if frame is None:
            self._controller.stalled()
        else:
            self._controller.push(frame.seq, frame.t_ns)
        return frame

    def close(self) -> None:
        """Dark first, then the camera. Safe to call twice."""
        try:
            self._controller.close()
        finally:
            self._source.close()

    def tune(self, camera: CameraCalibration) -> None:
        """As the camera's; the lights follow the exposure.

        Raises:
            CameraError: Refused by the camera, or its light would be on for longer than the rig file allows.
        """
        if not isinstance(self._source, Tunable):
            raise CameraError(f"camera {camera.name!r}: its driver can change no settings")
        try:
            check_pulses(self._rig, camera)
        except CalibrationError as error:
            raise CameraError(f"{error}; the settings before are still in use") from error
        longer = replace(camera, exposure_us=max(camera.exposure_us, self._camera.exposure_us))
        self._controller.expose(_exposed_us(longer))  # while it is between the two
        try:
            self._source.tune(camera)
            self._camera = camera
        finally:
            self._controller.expose(_exposed_us(self._camera))

    def metrics(self) -> dict[str, float]:
        """Those of the camera."""
        return dict(self._source.metrics()) if isinstance(self._source, Tunable) else {}

    def counts(self) -> dict[str, int]:
        """Those of the camera, and `lights.<event>`."""
        own = self._source.counts() if isinstance(self._source, Tunable) else dict[str, int]()
        return {**own, **self._controller.counts()}


def schedule_of(rig: RigCalibration, camera: CameraCalibration) -> StrobeSchedule:
    """What predicts the exposures of a camera of a rig with `strobe`.

    Raises:
        CalibrationError: As `check_pulses`.
    """
    strobe = check_pulses(rig, camera)
    offset_us = rig.stamp_offset_us.get(camera.name, 0.0) + 0.5 * _rows_us(camera)
    return StrobeSchedule(camera.frame_rate_hz, _exposed_us(camera), strobe.lead_us, offset_us)


def check_pulses(rig: RigCalibration, camera: CameraCalibration) -> StrobeCalibration:
    """Refuse an exposure that cannot be lit alone and within the limits; the limits.

    Raises:
        CalibrationError: With the keys, their values and the bound.
    """
    if rig.strobe is None:
        raise CalibrationError(
            f"rig {rig.name!r}: strobe: missing; lights are switched only within limits: power, pulse, duty"
            " (docs/safety.md)"
        )
    strobe, where = rig.strobe, f"camera {camera.name!r}: exposure_us {camera.exposure_us:g}"
    period_us = 1e6 / camera.frame_rate_hz
    pulse_us = strobe.lead_us + _exposed_us(camera) + MARGIN_NS * 1e-3
    if pulse_us > period_us:
        raise CalibrationError(
            f"{where} and row_time_us {camera.row_time_us:g} ({_rows_us(camera):.0f} us for all rows): with"
            f" strobe.lead_us {strobe.lead_us:g} its light would reach into the next frame, {period_us:.0f} us later"
        )
    if pulse_us > strobe.max_pulse_us:
        raise CalibrationError(
            f"{where}: needs light for {pulse_us:.0f} us, strobe.max_pulse_us of rig {rig.name!r} is"
            f" {strobe.max_pulse_us:g}"
        )
    if (duty := pulse_us / (len(CYCLE) * period_us)) > strobe.max_duty:
        raise CalibrationError(
            f"{where}: each light would be on for {duty:.3f} of the time, strobe.max_duty of rig {rig.name!r} is"
            f" {strobe.max_duty:g}"
        )
    return strobe


def _rows_us(camera: CameraCalibration) -> float:
    """From the first row to the last [us]; 0 of a global shutter."""
    return camera.height_px * camera.row_time_us


def _exposed_us(camera: CameraCalibration) -> float:
    """Return the time [us] in which any row of a frame is exposed.

    From the beginning of the first row's exposure to the end of the last one's.
    """
    return camera.exposure_us + _rows_us(camera)
