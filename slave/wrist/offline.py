"""Offline detection of a whole recording of a wrist camera.

Deterministic, without clock or network, a row per strobe cycle. The illumination label of a frame is not used: the
strobe estimates it from the frames, and where the two disagree it is counted.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.calibration import HandProfile, RigCalibration, load
from common.errors import CalibrationError, RecordingError
from common.messages import WristDetections
from common.recording.frame_recording import FrameRecording, Illumination, open_recording
from slave.cameras.replay import read_png
from slave.lights.controller import CYCLE
from slave.sources import Frame
from slave.wrist.detector import WristDetector
from slave.wrist.led_image import WristView

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class RecordedWristDetections:
    """Content of detections_<camera>.npz, T strobe cycles; NaN: finger not seen."""

    t_ns: Int  # (T,) middle of the exposure of row 0 of the laser frame [ns]
    seq: Int  # (T,) frame counter of the laser frame
    laser_uv: Float  # (T, 5, 2) where the laser meets each finger [px], distorted image
    laser_sigma_px: Float  # (T, 5) standard deviation per axis [px]
    laser_px: Float  # (T, 5) length of the part of the line that was seen [px]
    tip_uv: Float  # (T, 5, 2) fingertips [px]
    tip_sigma_px: Float  # (T, 5) standard deviation per axis [px]
    tip_depth: Float  # (T, 5) distance by the fall-off of the LED light, relative

    @classmethod
    def of(cls, found: list[WristDetections]) -> "RecordedWristDetections":
        """Row by row."""
        return cls(
            np.array([one.t_ns for one in found], np.int64),
            np.array([one.seq for one in found], np.int64),
            np.array([one.laser_uv for one in found]).reshape(-1, 5, 2),
            np.array([one.laser_sigma_px for one in found]).reshape(-1, 5),
            np.array([one.laser_px for one in found]).reshape(-1, 5),
            np.array([one.tip_uv for one in found]).reshape(-1, 5, 2),
            np.array([one.tip_sigma_px for one in found]).reshape(-1, 5),
            np.array([one.tip_depth for one in found]).reshape(-1, 5),
        )


@dataclass(frozen=True, slots=True, eq=False)
class WristRecordingFound:
    """A recording of a wrist camera, detected."""

    detections: RecordedWristDetections  # a row per strobe cycle
    frames: int  # read
    counts: Mapping[str, int]  # of the strobe: event -> how often
    mislabelled: int  # frames of recognised strobe cycles that were lit otherwise by frames.csv

    def summary(self) -> str:
        """One line for a person."""
        parts = [f"{self.frames} frames", f"{len(self.detections.t_ns)} strobe cycles"]
        events = {event: count for event, count in self.counts.items() if count and event != "cycles"}
        parts += [f"{event.replace('_', ' ')} {count}" for event, count in events.items()]
        lit = f"{self.mislabelled} frames lit otherwise than frames.csv says (its illumination is not used)"
        return ", ".join([*parts, lit] if self.mislabelled else parts)


def view_of(
    recording: FrameRecording, rig: RigCalibration, calibration: Path | None, hand_file: Path | None
) -> WristView:
    """What the wrist device of a recording knows of itself and of its hand.

    `calibration`: calib_json tree with hands/<hand of the rig>.json; `hand_file`: another hand profile.
    Raises CalibrationError: no hand profile, or something is not calibrated; the text names files and key.
    """
    if hand_file is None:
        if calibration is None:
            raise CalibrationError(
                f"{recording.folder}/recording.json: its fingers are those of hand {rig.hand!r}: give --hand FILE, or "
                f"--calibration DIR with DIR/hands/{rig.hand}.json"
            )
        hand_file = calibration / "hands" / f"{rig.hand}.json"
        if not hand_file.exists():
            raise CalibrationError(f"{hand_file}: no such hand profile: give --hand FILE")
    hand = load(hand_file, HandProfile)
    if hand.name != rig.hand:
        _LOG.warning(
            "%s: hand %r (%s), while the recording is of hand %r: its palm pose is that of the other",
            hand_file,
            hand.name,
            hand.side,
            rig.hand,
        )
    try:
        return WristView.of(rig, recording.manifest.cameras[rig.cameras[0]], hand)
    except CalibrationError as error:
        raise CalibrationError(f"{recording.folder}/recording.json with {hand_file}: {error}") from error


def detect_wrist_recording(
    folder: Path,
    camera: str,
    calibration: Path | None = None,
    hand_file: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> WristRecordingFound:
    """Detect laser points and fingertips in every strobe cycle of one camera.

    `calibration`: calib_json tree with the hand profile; `hand_file`: profile in its place; `progress`: called with
    frames done and frames in all.

    Raises:
        RecordingError: The recording is broken or has no such wrist camera or no frame of it.
        CalibrationError: No hand profile, or something is not calibrated.
        CameraError: A frame cannot be read.
    """
    recording = open_recording(folder)
    rig = recording.manifest.wrist_rig()
    rows = recording.frames_of(camera)
    if camera not in rig.cameras:
        raise RecordingError(f"{folder}: camera {camera!r} is not that of wrist rig {rig.name!r}")
    if not rows:
        raise RecordingError(f"{folder}/frames.csv: no frame of camera {camera!r}")
    own = recording.manifest.cameras[camera]
    detector = WristDetector(view_of(recording, rig, calibration, hand_file), own.frame_rate_hz)
    # Not their images, of which a long recording has more than memory holds.
    found: list[WristDetections] = []
    mislabelled = 0
    for i, row in enumerate(rows):
        image = read_png(folder / row.file, (own.height_px, own.width_px), grey=True)
        frame = Frame(row.seq, row.t_ns, row.t_ns, image, row.illumination, exposure_us=own.exposure_us)
        if (seen := detector.push(frame)) is not None:
            found.append(seen.message(camera, session=0))
            frames = (seen.cycle.ambient, seen.cycle.laser, seen.cycle.led)
            mislabelled += sum(
                frame.illumination not in (lit, Illumination.NONE)  # NONE is no label
                for frame, lit in zip(frames, CYCLE, strict=True)
            )
        progress(i + 1, len(rows))
    detections = RecordedWristDetections.of(found)
    return WristRecordingFound(detections, len(rows), detector.counts, mislabelled)
