"""Evidence of the detector for markers and for other things, and the fit of `slave.markers.quality` to it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from bench.markers.photos import Photo, as_by_another_camera, halves, painted, photos
from bench.report import CALIBRATION, ROOT, datasets
from common.arrays import Bool, Float, Image
from common.calibration import CameraCalibration, HsvRange, load
from common.errors import FitError
from common.recording.frame_recording import open_recording
from slave.markers.classify import ColourTable
from slave.markers.colours import calibrate, grow
from slave.markers.detector import Detections, MarkerDetector

SIX: Final = ("thumb", "index", "middle", "ring", "little", "back")
MARKED: Final = ROOT / "tests/golden/real_ball.json"
RENDERED: Final = {
    "lights_0_warm": 1,
    "flex90": 5,
    "translate_8ms": 5,
    "poses_left": 1,
}  # every so many-th frame
VISIBLE: Final = 0.5
GREEN: Final = HsvRange(
    hsv_low=(38, 60, 20), hsv_high=(88, 255, 255)
)  # where a person would click on the ball
PAINTINGS: Final = 4  # of one photograph
RIDGE: Final = 1.0  # of the weights, in standard deviations of the evidence, against one detection
ROUNDS: Final = 30
FAMILIES: Final = ("painted", "rendered", "ball")  # of markers, which count alike


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """N detections.

    Attributes:
        evidence: (N, K) as of `Evidence`.
        quality: (N,) what the detector says.
        right: (N,) whether it is the marker.
        source: (N,) what it was found in.
        photos: Source -> photographs without paint that were looked at.
    """

    evidence: Float
    quality: Float
    right: Bool
    source: tuple[str, ...]
    photos: Mapping[str, int]

    def of(self, chosen: Bool) -> "Rows":
        """A part of the rows."""
        source = tuple(s for s, ok in zip(self.source, chosen, strict=True) if ok)
        return Rows(self.evidence[chosen], self.quality[chosen], self.right[chosen], source, self.photos)


class Collector:
    """Holds the rows so far, and the tables of colours, which take long to make."""

    def __init__(self) -> None:
        """Nothing was looked at yet."""
        self._rows: list[tuple[tuple[float, ...], float, bool, str]] = []
        self._tables: dict[tuple[HsvRange, ...], ColourTable] = {}
        self._photos: dict[str, int] = {}

    def rows(self) -> Rows:
        """What was found so far."""
        evidence, quality, right, source = zip(*self._rows, strict=True)
        return Rows(np.array(evidence), np.array(quality), np.array(right), tuple(source), self._photos)

    def look(
        self, source: str, image: Image, ranges: Mapping[str, HsvRange], uv: Float | None, radius: Float
    ) -> Detections:
        """Detect in one picture; what is found farther than `radius` (M,) from `uv` (M, 2) [px] is false."""
        names = tuple(ranges)
        camera = camera_for(image, ranges)
        key = tuple(ranges.values())
        if key not in self._tables:
            self._tables[key] = MarkerDetector(camera, names).table
        detector = MarkerDetector(camera, names, table=self._tables[key])
        found = detector.push(image, 0)
        for m, evidence in detector.evidence.items():
            right = uv is not None and bool(np.hypot(*(found.uv[m] - uv[m])) <= max(radius[m], 3.0))
            self._rows.append((tuple(evidence), float(found.quality[m]), right, source))
        return found

    def look_at_photo(self, photo: Photo, rng: np.random.Generator, *, enlarged: bool = True) -> None:
        """Look at a photograph without paint, and at it and its parts by other cameras; then paint it."""
        ranges = shipped()
        nowhere = np.zeros(len(ranges))
        self._photos[photo.source] = self._photos.get(photo.source, 0) + 1
        self.look(f"photo {photo.source}", photo.image, ranges, None, nowhere)
        if enlarged:
            for part in halves(photo.image):
                self.look(f"parts {photo.source}", as_by_another_camera(part, rng), ranges, None, nowhere)
        for _ in range(PAINTINGS):
            view = painted(photo, rng)
            image = as_by_another_camera(view.image, rng)
            of_kind = view.kind.camera.markers or {}
            self.look(
                f"painted {photo.source}",
                image,
                {n: of_kind[n] for n in view.kind.names},
                view.uv,
                view.radius,
            )

    def look_at_rendered(self, rng: np.random.Generator) -> None:
        """Look at rendered hands, as they are and by other cameras, with colours of one picture."""
        folder = datasets() / "stereo"
        for name, every in RENDERED.items():
            recording = open_recording(folder / name)
            with np.load(folder / name / "truth.npz") as data:
                uv, share, area = data["uv"], data["frac"], data["px"]
            for c, camera in enumerate(("left", "right")):
                ranges = self._clicked(camera)
                for k, row in enumerate(recording.frames_of(camera)):
                    if k % every == 0:
                        image = np.asarray(cv2.imread(str(folder / name / row.file)), np.uint8)
                        t = min(k, len(uv) - 1)
                        place = np.where(share[t, c, :, None] > 0.0, uv[t, c], np.nan)
                        radius = np.sqrt(np.nan_to_num(area[t, c]) / np.pi)
                        for seen in (image, as_by_another_camera(image, rng)):
                            self.look("rendered", seen, ranges, place, radius)

    def look_at_ball(self, rng: np.random.Generator, clicks: int, *, other: bool = True) -> None:
        """Look at a real ball with colours of one click each."""
        marked, images = ball()
        for ranges in clicked_ranges(marked, images, rng, clicks):
            for frame, (u, v, radius) in marked.items():
                image = as_by_another_camera(images[frame], rng) if other else images[frame]
                self.look("ball", image, {"ball": ranges}, np.array([[u, v]]), np.array([radius]))

    def _clicked(self, camera: str) -> dict[str, HsvRange]:
        recording = open_recording(datasets() / "stereo/calib_colors")
        row = recording.frames_of(camera)[0]
        image = np.asarray(cv2.imread(str(recording.folder / row.file)), np.uint8)
        clicks = recording.manifest.clicks[camera]
        return {row.name: row.range for row in calibrate(image, {name: clicks[name] for name in SIX})}


def collected(seed: int = 1) -> Rows:
    """Return everything there is to fit to."""
    collector, rng = Collector(), np.random.default_rng(seed)
    for photo in photos():
        collector.look_at_photo(photo, rng)
    collector.look_at_rendered(rng)
    collector.look_at_ball(rng, 6)
    return collector.rows()


def fit(rows: Rows) -> Float:
    """Return bias and weights (1 + K,) of a logistic regression in which markers and others count alike.

    Newton's method (iteratively reweighted least squares; McCullagh and Nelder 1989, section 4.4), with a ridge.
    """
    x, y, weight = rows.evidence, rows.right.astype(np.float64), weights_of(rows)
    scale = np.maximum(x.std(axis=0), 1e-6)
    design = np.column_stack([np.ones(len(x)), x / scale])
    ridge = RIDGE * np.diag([0.0, *np.ones(x.shape[1])])
    beta = np.zeros(design.shape[1])
    for _ in range(ROUNDS):
        p = 1.0 / (1.0 + np.exp(-np.clip(design @ beta, -30.0, 30.0)))
        gradient = design.T @ (weight * (y - p)) - ridge @ beta
        hessian = (design * (weight * p * (1.0 - p))[:, None]).T @ design + ridge
        beta = beta + np.linalg.solve(hessian, gradient)
    return np.concatenate([beta[:1], beta[1:] / scale])


def weights_of(rows: Rows) -> Float:
    """Return weights (N,) with which markers and others count alike, and so does each family of markers."""
    family = np.array([source.split()[0] for source in rows.source])
    weight = np.zeros(len(family))
    groups = [rows.right & (family == name) for name in FAMILIES] + [~rows.right]
    shares = [1.0 / len(FAMILIES)] * len(FAMILIES) + [1.0]
    for group, share in zip(groups, shares, strict=True):
        if group.any():
            weight[group] = share / group.sum()
    return weight * (~rows.right).sum()


def reliability(
    quality: Float, right: Float, weight: Float, bins: int = 5
) -> list[tuple[float, float, float]]:
    """Return (mean stated, found, share of all) of each bin of stated quality that is not empty."""
    bin_of = np.minimum((quality * bins).astype(int), bins - 1)
    table: list[tuple[float, float, float]] = []
    for k in range(bins):
        mine = bin_of == k
        if weight[mine].sum() > 0.0:
            stated, found = (float(np.average(v[mine], weights=weight[mine])) for v in (quality, right))
            table.append((stated, found, float(weight[mine].sum() / weight.sum())))
    return table


def shipped() -> dict[str, HsvRange]:
    """The colours of the six markers in the camera file that is shipped."""
    markers = load(CALIBRATION / "cameras/left.json", CameraCalibration).markers or {}
    return {name: markers[name] for name in SIX}


def camera_for(image: Image, ranges: Mapping[str, HsvRange]) -> CameraCalibration:
    """A camera of the size of a picture."""
    return CameraCalibration(
        version=1,
        name="photo",
        width_px=image.shape[1],
        height_px=image.shape[0],
        frame_rate_hz=30.0,
        exposure_us=5000.0,
        analogue_gain=1.0,
        colour_gains=(1.0, 1.0),
        row_time_us=20.0,
        markers=dict(ranges),
    )


def ball() -> tuple[dict[str, tuple[float, float, float]], dict[str, Image]]:
    """Circles (u, v, radius) [px] of the frames of a real ball that were marked, and these frames."""
    marked = json.loads(MARKED.read_text())["circles_u_v_radius_px"]
    folder = datasets() / "real_ball"
    images = {name: np.asarray(cv2.imread(str(folder / f"{name}.jpg")), np.uint8) for name in marked}
    return {name: tuple(circle) for name, circle in marked.items()}, images


def clicked_ranges(
    marked: Mapping[str, tuple[float, float, float]],
    images: Mapping[str, Image],
    rng: np.random.Generator,
    count: int,
) -> list[HsvRange]:
    """Ranges of the ball by one random click each, on what is green of it in a random frame."""
    names = sorted(marked)
    found: list[HsvRange] = []
    while len(found) < count:
        name = names[rng.integers(len(names))]
        u, v, radius = marked[name]
        t, away = rng.uniform(0.0, 2.0 * np.pi), radius * np.sqrt(rng.random())
        click = (u + away * np.cos(t), v + away * np.sin(t))
        hsv = np.asarray(cv2.cvtColor(images[name], cv2.COLOR_BGR2HSV), np.uint8)
        low, high = np.array(GREEN.hsv_low), np.array(GREEN.hsv_high)
        pixel = hsv[round(click[1]), round(click[0])]
        if np.all((pixel >= low) & (pixel <= high)):
            try:
                grow(hsv, "ball", click)
            except FitError:
                continue  # as a person would be told to click again
            found.append(calibrate(images[name], {"ball": click})[0].range)
    return found
