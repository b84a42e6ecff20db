"""A wrist device sees lit boards, whose poses are found in its pictures.

Wrist device that is calibrated: its rig and camera.

From the recording or from a calib_json tree.

Strobed views of a thing held still.

The frames of one moment by what lit them, from a recording or from images.

Pose of a board before one camera, and its uncertainty.

The start of all that boards measure of a wrist device.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, RigCalibration, load
from common.command_line import echo
from common.errors import CalibrationError, FitError, PictureError, RecordingError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import cross, transform
from common.recording.frame_recording import MANIFEST, FrameRow, Illumination, open_recording
from common.recording.pictures import decode_file, read_picture
from master.calibrate.cameras.boards import Board, board_corners, find_board
from master.calibrate.cameras.bundle import place_board
from master.calibrate.tree_files import rig_in_tree, write_rig


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """A wrist device.

    Attributes:
        rig: Its rig file; the one in the tree of the results where there is one.
        file_name: Of the rig file, without .json.
        camera: Its camera file.
        optics: The same as geometry; its frame is that of the rig.
        source: Name of the folder that is measured, as provenance names it.
    """

    rig: RigCalibration
    file_name: str
    camera: CameraCalibration
    optics: CameraModel
    source: str


def device_of(source: Path, rig_name: str | None, calibration: Path, out: Path | None) -> Device:
    """The device, and the rig file that is to be written.

    Args:
        source: Recording, or folder of images or detections.
        rig_name: A rig of the tree `calibration`; None: the recording's own, with the recording's own camera.
        calibration: calib_json tree.
        out: Tree of the results.

    Raises:
        RecordingError: The recording cannot be read, or has no wrist rig.
        CalibrationError: A file is missing, broken, of another kind, or without intrinsics.
    """
    recorded = open_recording(source).manifest if (source / MANIFEST).is_file() else None
    if rig_name is None and recorded is None:
        raise CalibrationError(f"{source}: is no recording, which would name its rig: give --rig NAME")
    if rig_name is None and recorded is not None:
        try:
            rig = recorded.wrist_rig()
        except RecordingError as error:
            raise RecordingError(f"{source}/{error}: it is no recording of a wrist device") from error
        name, camera = rig.name, recorded.cameras[rig.cameras[0]]
    else:
        name = str(rig_name)
        rig = load(calibration / "rigs" / f"{name}.json", RigCalibration)
        if rig.kind != "wrist":
            raise CalibrationError(
                f"{calibration / 'rigs' / name}.json: kind is {rig.kind!r}; expected a rig of kind 'wrist'"
            )
        camera = load(calibration / "cameras" / f"{rig.cameras[0]}.json", CameraCalibration)
        if recorded is not None and camera.name not in recorded.cameras:
            raise CalibrationError(f"{source}: no camera {camera.name!r}, which rig {name!r} has")
    if camera.intrinsics is None:
        raise CalibrationError(
            f"camera {camera.name!r}: intrinsics is missing; measure it with `phalanx calibrate cameras intrinsics`"
        )
    optics = CameraModel.of(camera, np.eye(4))
    return Device(rig_in_tree(out, name, rig), name, camera, optics, source.resolve().name)


def print_line(lines: Iterable[str]) -> None:
    """Lines for a person."""
    for line in lines:
        echo(line)


def write_device(out: Path | None, device: Device, rig: RigCalibration, keys: str) -> Path | None:
    """Write the rig file with what was measured, and print that.

    None where no tree was given.

    Raises:
        CalibrationError: It cannot be written; the old file is untouched.
    """
    if out is None:
        echo("nothing written: give --out DIR")
        return None
    written = write_rig(out, device.file_name, rig)
    echo(f"wrote {written}: {keys}")
    return written


_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_NAMED = re.compile(r"(.*?)[-_ .]?(ambient|laser|led)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class LitView:
    """The frames of one moment.

    Attributes:
        name: How the view is called in reports: the number of its first frame, or what its files have in common.
        frames: What lit it -> how to load the frame (H, W), 8 bits.
    """

    name: str
    frames: Mapping[Illumination, Callable[[], Image]]

    def load(self, lit: Illumination) -> Image | None:
        """One of its frames; None where there is none of this kind.

        Raises:
            RecordingError: The file cannot be read, or is no image.
        """
        return self.frames[lit]() if lit in self.frames else None


def lit_views(folder: Path, camera: str, needed: Illumination) -> tuple[LitView, ...]:
    """Return views with an ambient frame and one lit by `needed`.

    Evenly over the source, at most 60.

    Args:
        folder: A recording whose frames.csv names the light of each frame, or images VIEW_ambient.png, VIEW_laser.png,
            VIEW_led.png.
        camera: Camera of the recording.
        needed: Laser or LED.

    Raises:
        RecordingError: No such folder, or no such frames; the text states what is expected.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: is not a folder")
    views = _recorded(folder, camera) if (folder / MANIFEST).is_file() else _named(folder)
    whole = [view for view in views if {Illumination.AMBIENT, needed} <= view.frames.keys()]
    if not whole:
        raise RecordingError(
            f"{folder}: no frame lit by the {needed} with an ambient one beside it: a recording states in frames.csv"
            f" what lit each frame; images are named VIEW_ambient.png, VIEW_{needed}.png"
        )
    most_views = 60  # more of the same motion adds time, not knowledge
    chosen = np.unique(np.linspace(0, len(whole) - 1, min(most_views, len(whole))).round().astype(int))
    return tuple(whole[int(i)] for i in chosen)


def _recorded(folder: Path, camera: str) -> list[LitView]:
    """Return one view for each ambient frame.

    With the frames lit otherwise that follow within a strobe cycle.
    """
    rows = open_recording(folder).frames_of(camera)
    if not rows:
        raise RecordingError(f"{folder}: camera {camera!r} has no frame")
    views: list[LitView] = []
    for i, row in enumerate(rows):
        if row.illumination is not Illumination.AMBIENT:
            continue
        cycle: dict[Illumination, FrameRow] = {row.illumination: row}
        apart = 2  # rows: frames of one strobe cycle
        for near in rows[i + 1 : i + 1 + apart]:
            if near.illumination is Illumination.AMBIENT or near.seq - row.seq > apart:
                break
            cycle.setdefault(near.illumination, near)
        views.append(
            LitView(str(row.seq), {lit: partial(load_grey, folder / one.file) for lit, one in cycle.items()})
        )
    return views


def _named(folder: Path) -> list[LitView]:
    """Images by their names."""
    found: dict[str, dict[Illumination, Callable[[], Image]]] = {}
    for file in sorted(folder.iterdir()):
        match = _NAMED.fullmatch(file.stem)
        if match is not None and file.suffix.lower() in _ENDINGS:
            found.setdefault(match[1], {})[Illumination(match[2].lower())] = partial(load_grey, file)
    return [LitView(name or "0", frames) for name, frames in found.items()]


def grouped_by_reason(refused: Mapping[str, str]) -> list[str]:
    """Format the refused views (name -> reason) as lines grouped by reason.

    Lines for a person: each reason once, after the views it is of; of many views the first.
    """
    views: dict[str, list[str]] = {}
    for name, reason in refused.items():
        views.setdefault(reason, []).append(name)
    lines: list[str] = []
    for reason, names in views.items():
        most_named = 6  # views named with a reason
        more = f" and {len(names) - most_named} more" if len(names) > most_named else ""
        lines.append(f"view{'s'[: len(names) > 1]} {', '.join(names[:most_named])}{more}: {reason}")
    return lines


def load_grey(file: Path) -> Image:
    """An image (H, W), 8 bits.

    Raises:
        RecordingError: The file cannot be read, or is no image.
    """
    try:
        return decode_file(read_picture(file), grey=True)
    except OSError as error:
        raise RecordingError(f"{file}: cannot read: {error.strerror}") from error
    except PictureError as error:
        raise RecordingError(f"{file}: is no image: it {error}") from error


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """A board in the camera's frame.

    Attributes:
        T_camera_board: (4, 4) [m].
        centre_m: (3,) middle of the corners, about which `covariance` turns.
        covariance: (6, 6) of small turns [rad] about the camera's axes and shifts [m], in this order.
        rms_px: What is left at the corners.
    """

    T_camera_board: Float
    centre_m: Float
    covariance: Float
    rms_px: float


def lens_of_model(optics: CameraModel) -> Float:
    """A camera's lens (9,) in the order of `bundle.LENS`."""
    k = optics.matrix
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *optics.distortion])


def board_pose(view: LitView, board: Board, optics: CameraModel) -> BoardPose:
    """Estimate the board pose of one view.

    At the middle of its strobe cycle where both of its ends show the board.

    Raises:
        RecordingError: An image cannot be read.
        FitError: No board, a wrong one, or one that moved; the text is the reason.
    """
    seen: list[Float] = []
    for lit in (Illumination.AMBIENT, Illumination.LED):
        image = view.load(lit)
        if image is None:
            continue
        if image.shape != (optics.height_px, optics.width_px):
            raise FitError(
                f"its image is {image.shape[1]} x {image.shape[0]} px,"
                f" the camera {optics.width_px} x {optics.height_px}"
            )
        if (observation := find_board(board, image)) is not None:
            seen.append(observation.corners_px)
    if not seen:
        raise FitError("no board found: show all of it with its white margin, sharp and not too bright")
    # The ambient frame comes before the laser's and the LED's after it: their mean is where the board was between.
    moved = float(np.nanmedian(np.linalg.norm(seen[0] - seen[-1], axis=1)))
    # between the frames of a strobe cycle; half of it is what a constant speed leaves unexplained
    moved_px = 1.0
    if not moved <= moved_px:
        raise FitError(f"the board moved by {moved:.1f} px between the frames: hold it still")
    return place_corners(np.mean(seen, axis=0), board, optics)


def place_corners(corners_px: Float, board: Board, optics: CameraModel) -> BoardPose:
    """The pose of a board from its corners (N, 2) [px], NaN where not seen.

    Raises:
        FitError: The corners do not agree with a flat board before this lens.
    """
    known = np.isfinite(corners_px[:, 0])
    drawn = board_corners(board)[known]
    T, rms = place_board(drawn, corners_px[known], lens_of_model(optics))
    most_rms_px = 1.0  # beyond it, it is another board or another lens
    if not rms <= most_rms_px:
        raise FitError(
            f"corners are off by {rms:.2f} px: the size of the board, its flatness or the intrinsics are wrong"
        )
    points = transform(T, drawn)
    centre = points.mean(axis=0)
    jacobian = np.stack([_pixel_derivative(points, centre, k, optics) for k in range(6)], axis=-1).reshape(
        -1, 6
    )
    dof = 2.0 * len(drawn) - 6.0
    # of the detector on rendered boards: what few corners that happen to agree do not get below
    corner_sigma_px = 0.05
    sigma = max(rms * np.sqrt(len(drawn) / dof), corner_sigma_px)
    return BoardPose(T, centre, sigma**2 * np.linalg.inv(jacobian.T @ jacobian), rms)


def _pixel_derivative(points: Float, centre: Float, k: int, optics: CameraModel) -> Float:
    """Derivative (n, 2) of the pixels by the k-th turn or shift."""
    step = np.zeros(3)
    step[k % 3] = 1e-5
    shift = cross(np.broadcast_to(step, points.shape), points - centre) if k < 3 else step
    return (optics.project(points + shift) - optics.project(points - shift)) / 2e-5
