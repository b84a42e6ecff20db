"""Open a camera that looks at the simulated scene, with faults on request.

Frame k is exposed when the slave's (perhaps skewed) clock reads `epoch + start offset + k periods`, until the rate is
changed, and handed over when a real sensor would have read out its last row. A process too slow for its rate loses
frames, of a strobe whole cycles, seen as gaps in `seq` and in `skipped`, and never works off a backlog. The camera of
a wrist device takes what its lights had on while it exposed (`slave.lights.strobed`); without lights it switches them
itself, frame k by k modulo 3. The lamp of the simulated room is such that the camera file of the scene exposes it
well; other settings make the picture brighter or darker against that.

Faults that come and go, for checklist rehearsals, are in a JSON file that is read again whenever it changes
(`--faults FILE`, docs/checklist.md). Settings that no real camera could take raise `CameraError`.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace

from common.arrays import Float, Image
from common.calibration import CameraCalibration
from common.calibration.camera_settings import figures
from common.calibration.files import decode_json
from common.clock import Clock, SkewedClock
from common.errors import CalibrationError, CameraError
from common.recording.frame_recording import Illumination
from common.sim.board import BoardScene
from common.sim.scene import Scene
from common.sim.scenes import renderer_of
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from slave.lights.controller import CYCLE as STROBE
from slave.lights.strobed import SimulatedStrobe
from slave.sources import Frame, Tunable


@dataclass(frozen=True, slots=True)
class _FrameTiming:
    """Exposure times: frame `seq` at `t_ns` [ns], the others at this rate."""

    seq: int
    t_ns: int
    rate_hz: float

    def exposed_ns(self, seq: int) -> int:
        """Middle of the exposure of row 0 of frame `seq`, own clock [ns]."""
        return self.t_ns + round((seq - self.seq) * 1e9 / self.rate_hz)


class SyntheticCamera(Tunable):
    """A `FrameSource` that renders its frames."""

    def __init__(
        self,
        scene: Scene | BoardScene | WristScene,
        camera: str | CameraCalibration,
        epoch_ns: int,
        clock: Clock,
        start_offset_ns: int,
        true_clock: Clock,
        sleep: Callable[[float], None] = time.sleep,
        lights: SimulatedStrobe | None = None,
        *,
        live: bool = False,
    ) -> None:
        """Prepare the renderer. It may join at any time: `seq` counts from the epoch.

        Args:
            scene: What it looks at; its files state what lens the camera has, and how it would be set well.
            camera: A camera of the scene's rig: its name, or a file of it that states how it is set.
            epoch_ns: Scene time 0, on the true clock [ns]; frame 0 is taken `start_offset_ns` later.
            lights: What lights a wrist device, on `clock`; None: this camera switches its lights itself.
            live: The scene does not wait for who draws it, so that is done as fast as looks right.

        Raises:
            CalibrationError: The scene has no such camera, or one of another size, or a marker without a colour.
        """
        name = camera if isinstance(camera, str) else camera.name
        self._renderer = renderer_of(scene, name, live=live)
        true = scene.cameras[name]
        camera = true if isinstance(camera, str) else camera
        size, true_size = ((one.width_px, one.height_px) for one in (camera, true))
        if size != true_size:
            raise CalibrationError(
                f"camera {camera.name!r}: width_px, height_px: {size[0]} x {size[1]}, the simulated camera has "
                f"{true_size[0]} x {true_size[1]}: write that into the camera file"
            )
        self._lit_for, self._camera = true, true
        self._clock, self._true, self._sleep = clock, true_clock, sleep
        self._epoch_ns, self._lights = epoch_ns, lights
        self._timing = _FrameTiming(0, self._own(epoch_ns + start_offset_ns), camera.frame_rate_hz)
        self._rows_ns = true.height_px * true.row_time_us * 1e3
        self._grey = scene.rig.kind == "wrist"
        self._cycle = len(STROBE) if isinstance(scene, WristScene) else 1
        self._next = 0
        self._started = False
        self._closed = False
        self.skipped = 0
        if camera != true:
            self.tune(camera)

    def read(self) -> Frame | None:
        """Draw the next frame, wait until it is due, hand it over; None once closed."""
        if self._closed:
            return None
        seq = self._due_next()
        t_ns = self._timing.exposed_ns(seq)
        image, lit = self._draw(seq, t_ns)
        self._next = seq + 1
        due = self._true_ns(t_ns + self._readout_ns)
        while (left_s := (due - self._true.now_ns()) * 1e-9) > 0.0:
            # 0.05 s at most at a time, so that a signal ends a wait soon
            self._sleep(min(left_s, 0.05))
        return Frame(seq, t_ns, self._clock.now_ns(), image, lit, exposure_us=self._camera.exposure_us)

    def close(self) -> None:
        """End the stream."""
        self._closed = True

    def tune(self, camera: CameraCalibration) -> None:
        """Take other exposure, gains and rate from the next frame on."""
        rate_hz = camera.frame_rate_hz
        if camera.exposure_us >= 1e6 / rate_hz:
            raise CameraError(
                f"exposure_us: wanted {camera.exposure_us:g}, a frame at {rate_hz:g} Hz has "
                f"{1e6 / rate_hz:g}; the settings before are still in use"
            )
        if self._rows_ns > 1e9 / rate_hz:
            raise CameraError(
                f"frame_rate_hz: wanted {rate_hz:g}, the rows of a frame are read out in {self._rows_ns * 1e-3:.0f} "
                f"us, so at most {1e9 / self._rows_ns:.4g}; the settings before are still in use"
            )
        if rate_hz != self._timing.rate_hz:  # the frame that is next comes when it would have come anyway
            self._timing = _FrameTiming(seq := self._next, self._timing.exposed_ns(seq), rate_hz)
        gains_bgr = _sensitivity(camera) / _sensitivity(self._lit_for)
        self._camera, self._renderer = camera, self._renderer.exposed(camera.exposure_us, gains_bgr)

    def metrics(self) -> dict[str, float]:
        """Its settings."""
        return figures(self._camera)

    def counts(self) -> dict[str, int]:
        """`camera.skipped`: frames it was too slow to draw, which count as dropped, too."""
        return {"camera.skipped": self.skipped}

    def _draw(self, seq: int, t_ns: int) -> tuple[Image, Illumination]:
        """Frame `seq`, mid-exposure at `t_ns` on its own clock, and what lit it."""
        t_s = (self._true_ns(t_ns) - self._epoch_ns) * 1e-9
        if isinstance(self._renderer, WristRenderer):
            if self._lights is not None:
                return self._draw_lit(self._renderer, t_s, t_ns, self._lights)
            lit = STROBE[seq % len(STROBE)]
            return self._renderer.render(t_s, lit), lit
        image = self._renderer.render(t_s)
        if self._grey:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        return image, Illumination.AMBIENT

    def _draw_lit(
        self, renderer: WristRenderer, t_s: float, t_ns: int, lights: SimulatedStrobe
    ) -> tuple[Image, Illumination]:
        """Add each light by the part of the exposure that it was on."""
        half_ns = round(self._camera.exposure_us * 500.0)
        lit = lights.during(t_ns - half_ns, t_ns + half_ns)
        shares = {Illumination.LASER: lit.laser, Illumination.LED: lit.led}
        # What lit 0.999 of an exposure lit all of it
        if all(share <= 0.0 or share >= 0.999 for share in shares.values()) and lit.laser * lit.led == 0.0:
            return renderer.render(t_s, lit.mostly), lit.mostly
        ambient = renderer.render(t_s, Illumination.AMBIENT).astype(np.float32)
        image = ambient.copy()
        for light, share in shares.items():
            if share > 0.0:
                image += np.float32(share) * (renderer.render(t_s, light) - ambient)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8), lit.mostly

    @property
    def _readout_ns(self) -> int:
        """From the middle of the exposure of row 0 to the last row's read-out [ns]."""
        return round(self._camera.exposure_us * 500.0 + self._rows_ns)

    def _due_next(self) -> int:
        """The next frame, or the first that is not yet read out; a strobe cycle is ended."""
        late_ns = self._clock.now_ns() - self._readout_ns - self._timing.exposed_ns(self._next)
        period_ns = 1e9 / self._timing.rate_hz
        begun = self._started and self._next % self._cycle != 0
        if begun or late_ns <= (0.5 * period_ns if self._started else 0.0):
            self._started = True
            return self._next
        seq = self._next + int(late_ns // period_ns) + 1
        seq += -seq % self._cycle
        if self._started:
            self.skipped += seq - self._next
        self._started = True
        return seq

    def _own(self, t_ns: int) -> int:
        return self._clock.from_true(t_ns) if isinstance(self._clock, SkewedClock) else t_ns

    def _true_ns(self, t_ns: int) -> int:
        return self._clock.to_true(t_ns) if isinstance(self._clock, SkewedClock) else t_ns


def _sensitivity(camera: CameraCalibration) -> Float:
    """Exposure [us] times the gains of blue, green and red (3,)."""
    red, blue = camera.colour_gains
    return camera.exposure_us * camera.analogue_gain * np.array([blue, 1.0, red])


_LOG = logging.getLogger(__name__)
Byte = Annotated[int, Meta(ge=0, le=255)]


class Patch(Struct, frozen=True, forbid_unknown_fields=True):
    """A disc of one colour before the camera: centre, radius [px], sRGB, blue first."""

    uv: tuple[float, float]
    radius_px: Annotated[float, Meta(gt=0.0, le=1000.0)]
    bgr: tuple[Byte, Byte, Byte]


class Faults(Struct, frozen=True, forbid_unknown_fields=True):
    """What is wrong with the camera; by default nothing."""

    # how many times as long as it was set it exposes: an automatic that was not switched off
    exposes: Annotated[float, Meta(gt=0.0, le=10.0)] = 1.0
    # how far the picture has moved since the calibration: somebody turned the camera a little
    moved_px: tuple[float, float] = (0.0, 0.0)
    patches: tuple[Patch, ...] = ()  # things before the camera that the scene does not have
    # of so many frames one is delivered: a camera, or a cable, that is too slow
    keep_one_in: Annotated[int, Meta(ge=1, le=100)] = 1
    # Of so many frames two come in the wrong order: the strobe of a wrist device slips. 0: none
    swap_every: Annotated[int, Meta(ge=0, le=1000)] = 0
    unplugged: bool = False  # it is not there: lost while it runs, and not to be opened
    raises: bool = False  # its driver raises an error that is none of ours at the next frame
    # it sends one picture again and again, with new stamps, also after it was opened again
    frozen: bool = False


class Frozen:
    """The one picture of a frozen camera, kept while it is opened again."""

    def __init__(self) -> None:
        self._image: Image | None = None

    def shown(self, image: Image, frozen: bool) -> Image:
        """What comes in place of a picture."""
        if not frozen:
            self._image = None
            return image
        if self._image is None:
            self._image = image
        return self._image


class FaultyCamera(Tunable):
    """A `FrameSource` and `Tunable` that adds faults to a simulated camera."""

    def __init__(
        self, source: SyntheticCamera, camera: CameraCalibration, path: Path, frozen: Frozen | None = None
    ) -> None:
        """Load the faults from the file `path`, which need not exist yet."""
        self._source, self._camera, self._path = source, camera, path
        self._faults = Faults()
        self._stat: tuple[int, int] | None = None
        self._looked_ns = 0
        self._count = 0
        self._held: Frame | None = None
        self._frozen = frozen or Frozen()
        self._look()
        self._refuse_unplugged()

    def read(self) -> Frame | None:
        """The next frame, spoiled; `RuntimeError`: what no driver of ours raises."""
        while (frame := self._source.read()) is not None:
            if frame.ready_t_ns - self._looked_ns >= 100_000_000:  # the file is looked at ten times a second
                self._looked_ns = frame.ready_t_ns
                try:
                    self._look()
                except CameraError as error:
                    _LOG.warning("%s", error)
                self._refuse_unplugged()
            if self._faults.raises:
                raise RuntimeError(
                    f"the driver of camera {self._camera.name!r} fails, as set in {self._path}"
                )
            self._count += 1
            if self._count % self._faults.keep_one_in:
                continue
            image = self._spoiled(self._swapped(frame))
            return replace(frame, image=self._frozen.shown(image, self._faults.frozen))
        return None

    def close(self) -> None:
        """End the stream."""
        self._source.close()

    def tune(self, camera: CameraCalibration) -> None:
        """As of the camera inside."""
        self._source.tune(self._exposed(camera, self._faults))
        self._camera = camera

    def metrics(self) -> dict[str, float]:
        """The actual settings: not the commanded ones where it exposes by itself."""
        return self._source.metrics()

    def counts(self) -> dict[str, int]:
        """Those of the camera inside."""
        return self._source.counts()

    def _refuse_unplugged(self) -> None:
        if self._faults.unplugged:
            raise CameraError(f"camera {self._camera.name!r} is unplugged, as set in {self._path}")

    def _look(self) -> None:
        """Read the file if it was changed; if it is broken, the faults stay as they were."""
        try:
            status = self._path.stat()
            stat, raw = (status.st_mtime_ns, status.st_ino), None
            if stat != self._stat:
                raw = self._path.read_bytes()
        except OSError:
            stat, raw = None, b"{}" if self._stat is not None else None
        self._stat = stat
        if raw is None:
            return
        try:
            faults = decode_json(raw, Faults, str(self._path))
        except CalibrationError as error:
            raise CameraError(str(error)) from error
        if faults.exposes != self._faults.exposes:
            self._source.tune(self._exposed(self._camera, faults))
        self._faults = faults

    def _exposed(self, camera: CameraCalibration, faults: Faults) -> CameraCalibration:
        return replace(camera, exposure_us=camera.exposure_us * faults.exposes)

    def _swapped(self, frame: Frame) -> Image:
        """The picture that comes under the stamp of `frame`."""
        held, self._held = self._held, None
        if held is not None:
            return held.image
        if self._faults.swap_every and self._count % self._faults.swap_every == 0:
            late = self._source.read()
            if late is not None:
                self._held = frame
                return late.image
        return frame.image

    def _spoiled(self, image: Image) -> Image:
        faults = self._faults
        if faults.moved_px != (0.0, 0.0):
            move = np.array([[1.0, 0.0, faults.moved_px[0]], [0.0, 1.0, faults.moved_px[1]]])
            size = image.shape[1], image.shape[0]
            image = np.asarray(cv2.warpAffine(image, move, size, borderMode=cv2.BORDER_REFLECT), np.uint8)
        if faults.patches:
            image = image.copy()
            for patch in faults.patches:
                middle = round(patch.uv[0]), round(patch.uv[1])
                colour = patch.bgr if image.ndim == 3 else (patch.bgr[1],)
                cv2.circle(image, middle, round(patch.radius_px), colour, cv2.FILLED, cv2.LINE_AA)
        return image
