"""A wrist device sees lit boards, whose poses are found in its pictures.

Rig and camera come from the recording or a calib_json tree; the frames of one moment, by what lit them, from
a recording or images. A board's pose and its uncertainty is the start of all that boards measure of a device.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar, cast

import cv2
import numpy as np
from msgspec.structs import replace

from common.arrays import Float, Image
from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError, FitError, RecordingError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import cross, transform
from common.recording.frame_recording import MANIFEST, FrameRow, Illumination, open_recording
from master.calibrate.cameras.boards import Board, board_corners, find_board
from master.calibrate.cameras.bundle import place_board
from master.calibrate.cameras.views import ENDINGS, Finder, load_image
from master.calibrate.observations import thinned
from master.calibrate.report import Write
from master.calibrate.tree_files import provenance, rig_in_tree, write_rig

Seen = TypeVar("Seen")


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """A wrist device."""

    rig: RigCalibration  # its rig file; the one in the tree of the results where there is one
    file_name: str  # of the rig file, without .json
    camera: CameraCalibration
    optics: CameraModel  # its camera as geometry, whose frame is that of the rig
    source: str  # name of the folder that is measured, as provenance names it


def device_of(source: Path, rig_name: str | None, calibration: Path, out: Path | None) -> Device:
    """The device of a recording or folder, and the rig file that is to be written.

    `rig_name` is a rig of the tree `calibration`; None: the recording's own, with its own camera. `out` is
    the tree of the results.

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


def writes_rig(device: Device, rig: RigCalibration, keys: str) -> Write:
    """Writes the rig file of a device with what was measured under `keys`."""
    return lambda out: {write_rig(out, device.file_name, rig): keys}


def writes_key(
    device: Device, command: str, key: str, value: object, residual: dict[str, float], note: str
) -> Write:
    """Writes one key of the rig file, as `calibrate wrist COMMAND` measured it."""
    how = provenance(f"calibrate wrist {command}", (device.source,), residual, note)
    rig = replace(device.rig, **{key: value}, provenance=device.rig.provenance | {key: how})
    return writes_rig(device, rig, key)


_NAMED = re.compile(r"(.*?)[-_ .]?(ambient|laser|led|board)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class LitView:
    """The frames of one moment."""

    # how the view is called in reports: the number of its first frame, or what its files have in common
    name: str
    # what lit it -> how to load the frame (H, W) or (H, W, 3) BGR, 8 bits
    frames: Mapping[Illumination, Callable[[], Image]]

    def load(self, lit: Illumination, *, colour: bool = False) -> Image | None:
        """One of its frames; None where there is none of this kind.

        Raises:
            RecordingError: The file cannot be read, or is no image.
        """
        image = self.frames[lit]() if lit in self.frames else None
        if image is None or image.ndim == 2 or colour:
            return image
        return cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def lit_views(folder: Path, camera: str, needed: Illumination) -> tuple[LitView, ...]:
    """Views with an ambient frame and one lit by `needed`, spread evenly, at most 60.

    From a recording whose frames.csv names the light of each frame, or images VIEW_ambient.png,
    VIEW_laser.png, VIEW_led.png or VIEW_board.png, which is the board in any light but the laser's. A laser's
    frame needs no ambient one (`laser_line`).

    Raises:
        RecordingError: No such folder, or no such frames; the text states what is expected.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: is not a folder")
    views = _recorded(folder, camera) if (folder / MANIFEST).is_file() else _named(folder)
    wanted = {needed} if needed is Illumination.LASER else {Illumination.AMBIENT, needed}
    whole = [view for view in views if wanted <= view.frames.keys()]
    if not whole:
        raise RecordingError(
            f"{folder}: no frame lit by the {needed} with an ambient one beside it: a recording states in frames.csv"
            f" what lit each frame; images are named VIEW_ambient.png, VIEW_{needed}.png"
            + (" (a laser's frame that shows the board may stand alone)" if len(wanted) == 1 else "")
        )
    most_views = 60  # more of the same motion adds time, not knowledge
    return tuple(whole[int(i)] for i in thinned(np.arange(len(whole)), most_views))


def _recorded(folder: Path, camera: str) -> list[LitView]:
    """A view for each ambient frame, with frames lit otherwise in its strobe cycle.

    Without any ambient frame, a view for each frame of the laser.
    """
    rows = open_recording(folder).frames_of(camera)
    if not rows:
        raise RecordingError(f"{folder}: camera {camera!r} has no frame")
    views: list[LitView] = []
    lit = {row.illumination for row in rows}
    first = Illumination.AMBIENT if Illumination.AMBIENT in lit else Illumination.LASER
    for i, row in enumerate(rows):
        if row.illumination is not first:
            continue
        cycle: dict[Illumination, FrameRow] = {row.illumination: row}
        apart = 2  # rows: frames of one strobe cycle
        for near in rows[i + 1 : i + 1 + apart]:
            if near.illumination is first or near.seq - row.seq > apart:
                break
            cycle.setdefault(near.illumination, near)
        frames = {lit: partial(load_image, folder / one.file) for lit, one in cycle.items()}
        views.append(LitView(str(row.seq), frames))
    return views


def _named(folder: Path) -> list[LitView]:
    found: dict[str, dict[Illumination, Callable[[], Image]]] = {}
    for file in sorted(folder.iterdir()):
        match = _NAMED.fullmatch(file.stem)
        if match is not None and file.suffix.lower() in ENDINGS:
            lit = match[2].lower()
            lit = Illumination.LED if lit == "board" else Illumination(lit)
            found.setdefault(match[1], {})[lit] = partial(load_image, file)
    return [LitView(name or "0", frames) for name, frames in found.items()]


def board_in_views(views: Sequence[LitView], board: Board) -> Board:
    """The board as the first view shows it: a ChArUco board in the printed layout.

    Raises:
        RecordingError: An image cannot be read.
        FitError: No view shows it; the text says what they show instead, or what to do.
    """
    finder = Finder(board)
    for view in views:
        for image in (image for lit in Illumination for image in _showing(view, lit)):
            if finder.find(image) is not None:
                return finder.board
    raise FitError(f"no board found in {len(views)} views, looking for the {board}: {finder.advice()}")


def of_views(
    views: Sequence[LitView], take: Callable[[LitView], Seen]
) -> tuple[dict[str, Seen], dict[str, str]]:
    """What `take` finds in each view, by name, and why (FitError) not in others."""
    found, refused = dict[str, Seen](), dict[str, str]()
    for view in views:
        try:
            found[view.name] = take(view)
        except FitError as error:
            refused[view.name] = str(error)
    return found, refused


def grouped_by_reason(refused: Mapping[str, str]) -> list[str]:
    """Refused views (name -> reason) as lines: each reason after its views.

    Of many views the first are named.
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


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """A board in the camera's frame."""

    T_camera_board: Float  # (4, 4) [m]
    centre_m: Float  # (3,) middle of the corners, about which `covariance` rotates
    covariance: Float  # (6, 6) of small rotations [rad] about the camera's axes and shifts [m], in this order
    rms_px: float  # residual of the corners


def board_pose(view: LitView, board: Board, optics: CameraModel) -> BoardPose:
    """Board pose of one view (`board_corners_of`)."""
    return place_corners(board_corners_of(view, board, optics), board, optics)


def board_corners_of(view: LitView, board: Board, optics: CameraModel) -> Float:
    """Corners (N, 2) [px] of one view, in the middle of its strobe cycle.

    Where both ends of the cycle show them; from the laser's frame only if nothing else does, its line taken out.

    Raises:
        RecordingError: An image cannot be read.
        FitError: No board, a wrong one, or one that moved; the text is the reason.
    """
    seen: list[Float] = []
    for lit in (Illumination.AMBIENT, Illumination.LED, Illumination.LASER):
        for image in () if lit is Illumination.LASER and seen else _showing(view, lit):
            if image.shape != (optics.height_px, optics.width_px):
                raise FitError(
                    f"its image is {image.shape[1]} x {image.shape[0]} px,"
                    f" the camera {optics.width_px} x {optics.height_px}"
                )
            if (observation := find_board(board, image)) is not None:
                seen.append(observation.corners_px)
                break
    if not seen:
        raise FitError("no board found: show all of it with its white margin, sharp and not too bright")
    # The ambient frame comes before the laser's and the LED's after it: their mean is where the board was between.
    # Half of its motion between the frames is what a constant speed leaves unexplained.
    moved = float(np.nanmedian(np.linalg.norm(seen[0] - seen[-1], axis=1)))
    if not moved <= 1.0:
        raise FitError(f"the board moved by {moved:.1f} px between the frames: hold it still")
    return np.mean(seen, axis=0)


def _showing(view: LitView, lit: Illumination) -> Iterator[Image]:
    """Images of one kind in which a board is sought; a laser's without its line.

    A line is thinner than 7 px, but small squares may be, too. A corner looks the same turned by 180 deg, so that
    opening the image leaves its place.
    """
    if (image := view.load(lit)) is not None:
        for line_px in (7, 5, 3) if lit is Illumination.LASER else (1,):
            yield cast(Image, cv2.morphologyEx(image, cv2.MORPH_OPEN, np.ones((line_px, line_px))))


def place_corners(corners_px: Float, board: Board, optics: CameraModel) -> BoardPose:
    """The pose of a board from its corners (N, 2) [px], NaN where not seen.

    Raises:
        FitError: The corners do not agree with a flat board before this lens.
    """
    known = np.isfinite(corners_px[:, 0])
    drawn = board_corners(board)[known]
    lens = np.append(optics.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], optics.distortion)
    T, rms = place_board(drawn, corners_px[known], lens)
    if not rms <= 1.0:  # beyond it, it is another board or another lens
        raise FitError(
            f"corners are off by {rms:.2f} px: the size of the board, its flatness or the intrinsics are wrong"
        )
    points = transform(T, drawn)
    centre = points.mean(axis=0)
    jacobian = np.stack([_pixel_derivative(points, centre, k, optics) for k in range(6)], -1).reshape(-1, 6)
    dof = 2.0 * len(drawn) - 6.0
    # At least that of the detector on rendered boards: few corners may happen to agree.
    sigma = max(rms * np.sqrt(len(drawn) / dof), 0.05)
    return BoardPose(T, centre, sigma**2 * np.linalg.inv(jacobian.T @ jacobian), rms)


def _pixel_derivative(points: Float, centre: Float, k: int, optics: CameraModel) -> Float:
    """Derivative (n, 2) of the pixels by the k-th rotation or shift."""
    step = np.zeros(3)
    step[k % 3] = 1e-5
    shift = cross(np.broadcast_to(step, points.shape), points - centre) if k < 3 else step
    return (optics.project(points + shift) - optics.project(points - shift)) / 2e-5
