"""Light the frames of a camera, real or simulated, by a strobe.

Every frame's stamp goes to the strobe on its way to the detector. Real lights are switched by a process of their own:
a thread waits for Python's lock while another computes, whatever its priority (docs/safety.md). A simulated camera
waits for the strobe: before a frame is drawn, everything that the strobe would have done up to the end of its
exposure is done, each at the moment it asked for; a thread would be as late as the drawing makes it, which no real
device suffers from. An exposure that cannot be lit so raises `CalibrationError`; in a running camera `CameraError`.
"""

import contextlib
import logging
import os
import select
import signal
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import msgspec
from msgspec.structs import replace

from common.calibration import CameraCalibration, RigCalibration
from common.calibration.strobe import StrobeCalibration
from common.clock import Clock, SkewedClock, SystemClock
from common.errors import CalibrationError, CameraError, LightsError
from common.recording.frame_recording import Illumination
from slave.lights.controller import CYCLE, MARGIN_NS, Strobe, StrobeSchedule
from slave.lights.interlock import Interlock, Lights
from slave.sources import Frame, FrameSource, Tunable


class StrobedCamera(Tunable):
    """A `FrameSource` around another, lit by a strobe; `Tunable` where that is."""

    def __init__(
        self,
        source: FrameSource,
        camera: CameraCalibration,
        rig: RigCalibration,
        controller: "Strobe | StrobeProcess",
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


def switched_lights(lights: str, strobe: StrobeCalibration) -> Lights | None:
    """Open the real driver that `--lights` names, dark; None: it is no such driver."""
    kind, _, place = lights.partition(":")
    if kind == "gpio":
        from slave.lights.gpio import GpioLights

        return GpioLights(place, strobe.max_pulse_us * 1e-6)
    if kind == "i2c":
        from slave.lights.i2c_led import FlashDriverLights

        return FlashDriverLights(place, strobe)
    return None


class _Job(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a strobe's process lights, and by what."""

    lights: str
    rig: RigCalibration
    camera: CameraCalibration


_NEWS = struct.Struct("=cqq")  # what it is, number, time [ns]
_FRAME, _EXPOSURE, _STALLED = b"f", b"e", b"s"
_LOG = logging.getLogger(__name__)


class StrobeProcess:
    """A `Strobe` before real lights, in a real-time process of its own.

    It ends, dark, when this one does or closes its pipe. One that ended otherwise is started again, and counted.
    """

    def __init__(
        self, lights: str, rig: RigCalibration, camera: CameraCalibration, clock: SkewedClock
    ) -> None:
        """Start it, dark; raises its `LightsError`."""
        job = msgspec.json.encode(_Job(lights, rig, camera)).decode()
        run = "import sys; from slave.lights.strobed import run_strobe; sys.exit(run_strobe(sys.argv[1]))"
        self._command = [sys.executable, "-c", run, job]
        self._clock, self._exposure_us = clock, _exposed_us(camera)
        self._before: dict[str, int] = {"lights.restarted": 0}  # of the processes that ended
        self._counts: dict[str, int] = {}
        self._fault = ""
        self._again_ns = 0
        self._process = self._started()
        assert self._process.stdout is not None
        patience_s = 60.0  # a processor that is busy with the slave's own start
        select.select([self._process.stdout], [], [], patience_s)
        self._read()
        if not self._counts:
            self._end()
            raise LightsError(
                self._fault or f"--lights {lights}: its process says nothing for {patience_s:.0f} s"
            )

    def push(self, seq: int, t_ns: int) -> None:
        """Take a frame's mid-exposure [ns]."""
        self._send(_FRAME, seq, self._clock.to_true(t_ns))

    def expose(self, exposure_us: float) -> None:
        """Take another exposure time [us]."""
        self._exposure_us = exposure_us
        self._send(_EXPOSURE, 0, round(exposure_us * 1e3))

    def stalled(self) -> None:
        """Go dark, and forget the stamps: there are no frames any more."""
        self._send(_STALLED, 0, 0)

    def counts(self) -> dict[str, int]:
        """`lights.<event>` -> how often, as it reported a quarter of a second ago."""
        self._read()
        return {
            event: self._before.get(event, 0) + self._counts.get(event, 0)
            for event in {**self._before, **self._counts}
        }

    def close(self) -> None:
        """Have it go dark and end. Safe to call twice."""
        if self._process is None:
            return
        code = self._end()
        self._process = None
        self._again_ns = sys.maxsize
        if code != 0:
            raise LightsError(self._fault or f"the process of the lights ended with {code}")

    def _send(self, what: bytes, number: int, t_ns: int) -> None:
        if self._process is None:
            if self._clock.now_ns() < self._again_ns:
                return
            self._process = self._started()
            self.expose(self._exposure_us)
        assert self._process.stdin is not None
        try:
            os.write(self._process.stdin.fileno(), _NEWS.pack(what, number, t_ns))
        except OSError:  # it has ended, or is stopped and its pipe is full
            code = self._end()
            self._process = None
            self._again_ns = self._clock.now_ns() + 5_000_000_000
            self._before = {**self.counts(), "lights.restarted": self._before["lights.restarted"] + 1}
            self._counts = {}
            _LOG.warning("lights: their process ended with %d and is started again: %s", code, self._fault)

    def _started(self) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0, start_new_session=True
        )
        assert process.stdin is not None
        assert process.stdout is not None
        os.set_blocking(process.stdin.fileno(), False)  # no frame waits for it
        os.set_blocking(process.stdout.fileno(), False)
        return process

    def _end(self) -> int:
        """Close its pipe; its exit code, once it has ended."""
        process = self._process
        assert process is not None
        assert process.stdin is not None
        process.stdin.close()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._read()
        return process.returncode

    def _read(self) -> None:
        """Take its last counts, or what is wrong: lines of JSON."""
        if self._process is None:
            return
        assert self._process.stdout is not None
        for line in (self._process.stdout.read() or b"").splitlines():
            found = msgspec.json.decode(line, type=dict[str, int] | str)
            if isinstance(found, str):
                self._fault = found
            else:
                self._counts = found


def run_strobe(job: str) -> int:
    """Switch lights as a process of its own, until standard input ends."""
    for number in (signal.SIGABRT, signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the slave ends first
    logging.basicConfig(level=logging.INFO, format="phalanx-slave: %(message)s")
    wanted, clock = msgspec.json.decode(job, type=_Job), SystemClock()
    os.set_blocking(1, False)

    def report(what: dict[str, int] | str) -> None:
        with contextlib.suppress(OSError):  # the slave does not read, or has ended
            os.write(1, msgspec.json.encode(what) + b"\n")

    refused = _ask_for_real_time()
    strobe: Strobe | None = None
    try:
        schedule = schedule_of(wanted.rig, wanted.camera)
        limits = check_pulses(wanted.rig, wanted.camera)
        lights = switched_lights(wanted.lights, limits)
        assert lights is not None  # its name was checked
        strobe = Strobe(schedule, Interlock(lights, limits, clock), clock)
        strobe.missed["not_realtime"] = refused
        report(strobe.counts())
        _switch(strobe, clock, report)
        strobe.close()
    except LightsError as error:
        report(str(error))
        return 1
    return 0


def _ask_for_real_time() -> int:
    """Run before all work of ordinary programs, with all threads to come; 1: refused."""
    priority = 10  # of 1 to 99; the kernel's own threads have 50. strobe.conf of the unit allows as much
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        more = "a service gets it by its installer (strobe.conf), a program started by hand by `ulimit -r`"
        _LOG.warning("lights: no real-time priority for the strobe (%s): %s", error.strerror, more)
        return 1
    return 0


def _switch(strobe: Strobe, clock: Clock, report: Callable[[dict[str, int] | str], None]) -> None:
    """Do what is due, and take news, until there are none any more."""
    reported_ns = 0
    while True:
        again_ns = strobe.step()
        left_s = 0.5 if again_ns is None else max((again_ns - clock.now_ns()) * 1e-9, 0.0)
        if not select.select([0], [], [], left_s)[0]:
            continue
        news = os.read(0, 64 * _NEWS.size)
        if not news:
            return
        for what, number, t_ns in _NEWS.iter_unpack(news):  # each was written whole
            if what == _FRAME:
                strobe.push(number, t_ns)
            elif what == _EXPOSURE:
                strobe.expose(t_ns * 1e-3)
            else:
                strobe.stalled()
        if (now_ns := clock.now_ns()) - reported_ns > 200_000_000:
            reported_ns = now_ns
            report(strobe.counts())


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
