"""Light the frames of a camera, real or simulated, by a strobe.

Every frame's stamp goes to the strobe on its way to the detector. A simulated camera waits for the strobe: before a
frame is drawn, everything that the strobe would have done up to the end of its exposure is done, each at the moment
it asked for; a thread would be as late as the drawing makes it, which no real device suffers from. An exposure that
cannot be lit so raises `CalibrationError`; in a running camera `CameraError`.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from msgspec.structs import replace

from common.calibration import CameraCalibration, RigCalibration
from common.calibration.strobe import StrobeCalibration
from common.clock import Clock
from common.errors import CalibrationError, CameraError
from common.recording.frame_recording import Illumination
from slave.lights.controller import CYCLE, MARGIN_NS, Strobe, StrobeSchedule
from slave.lights.interlock import Interlock, Lights
from slave.sources import Frame, FrameSource, Tunable


class StrobedCamera(Tunable):
    """A `FrameSource` around another, lit by a strobe; `Tunable` where that is."""

    def __init__(
        self, source: FrameSource, camera: CameraCalibration, rig: RigCalibration, controller: Strobe
    ) -> None:
        """Begin dark; light comes once the stamps are understood."""
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
        """As the camera's; the lights follow the exposure."""
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
    """What predicts the exposures of a camera; raises as `check_pulses`."""
    strobe = check_pulses(rig, camera)
    offset_us = rig.stamp_offset_us.get(camera.name, 0.0) + 0.5 * _rows_us(camera)
    return StrobeSchedule(camera.frame_rate_hz, _exposed_us(camera), strobe.lead_us, offset_us)


def check_pulses(rig: RigCalibration, camera: CameraCalibration) -> StrobeCalibration:
    """Refuse an exposure that cannot be lit alone and within the limits; the limits."""
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
    """From the start of the first row's exposure to the end of the last one's [us]."""
    return camera.exposure_us + _rows_us(camera)


@dataclass(frozen=True, slots=True)
class Lit:
    """How much of an exposure each light was on, 0 to 1."""

    laser: float
    led: float

    @property
    def mostly(self) -> Illumination:
        """What a frame is called that was exposed so."""
        if max(self.laser, self.led) <= 0.0:
            return Illumination.AMBIENT
        return Illumination.LASER if self.laser >= self.led else Illumination.LED


class SyntheticLights(Lights):
    """`Lights` that only record what was on when, by `clock`; read from any thread."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._closed = clock, False
        # Four switchings per cycle of the strobe, so some seconds
        self._switched: deque[tuple[int, Illumination]] = deque(maxlen=512)

    def switch(self, lit: Illumination) -> None:
        """Have it on from now on."""
        if not self._closed:
            self._switched.append((self._clock.now_ns(), lit))

    def during(self, start_ns: int, stop_ns: int) -> Lit:
        """What was on from `start_ns` to `stop_ns`, which is later [ns]."""
        on_ns = {Illumination.LASER: 0, Illumination.LED: 0}
        for (t_ns, lit), (end_ns, _) in pairwise([*tuple(self._switched), (stop_ns, Illumination.AMBIENT)]):
            if lit in on_ns:
                on_ns[lit] += max(min(end_ns, stop_ns) - max(t_ns, start_ns), 0)
        whole_ns = stop_ns - start_ns
        return Lit(on_ns[Illumination.LASER] / whole_ns, on_ns[Illumination.LED] / whole_ns)

    def close(self) -> None:
        """Go dark for good."""
        self.off()
        self._closed = True

    def counts(self) -> dict[str, int]:
        """Nothing can happen to it."""
        return {}


class _SetClock(Clock):
    def __init__(self) -> None:
        self.t_ns = 0

    def now_ns(self) -> int:
        return self.t_ns


class SimulatedStrobe(Strobe):
    """Keeps a synthetic camera lit, without a thread."""

    def __init__(
        self, schedule: StrobeSchedule, strobe: StrobeCalibration, late_ns: Callable[[], int] = lambda: 0
    ) -> None:
        """Begin dark; `late_ns`: how much later than asked for the strobe comes [ns]."""
        self._late_ns, self._set_clock = late_ns, _SetClock()
        self._lights = SyntheticLights(self._set_clock)
        interlock = Interlock(self._lights, strobe, self._set_clock, watch=False)
        super().__init__(schedule, interlock, self._set_clock)
        self._again_ns: int | None = None

    def during(self, start_ns: int, stop_ns: int) -> Lit:
        """What is on from `start_ns` to `stop_ns` [ns], not before any time asked so far."""
        while self._again_ns is not None and self._again_ns <= stop_ns:
            self._monitored(self._again_ns)
            self._set_clock.t_ns = max(self._again_ns, self._set_clock.t_ns)
            self._ask()
        self._monitored(stop_ns)
        self._set_clock.t_ns = max(stop_ns, self._set_clock.t_ns)
        return self._lights.during(start_ns, stop_ns)

    def push(self, seq: int, t_ns: int) -> None:
        """As of `Strobe`."""
        super().push(seq, t_ns)
        if self._again_ns is None:
            self._ask()

    def stalled(self) -> None:
        """As of `Strobe`."""
        super().stalled()
        self._again_ns = None

    def _ask(self) -> None:
        again_ns = self.step()
        self._again_ns = None if again_ns is None else again_ns + self._late_ns()

    def _monitored(self, until_ns: int) -> None:
        """What the watchdog does until then."""
        while (left_s := self._interlock.look()) is not None:
            at_ns = self._set_clock.t_ns + max(round(left_s * 1e9), 1)
            if at_ns > until_ns:
                return
            self._set_clock.t_ns = at_ns
