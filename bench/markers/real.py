"""Markers in real pictures: a lit ball that a hand holds, and photographs without markers.

python -m bench real_markers                                     with PHALANX_DATASETS, perhaps PHALANX_PHOTOS
python -m bench real_markers --fit [--held-out SOURCE,...]       weights for slave/markers/quality.py

Whatever is found in a photograph without markers is false. Any will do: `PHALANX_PHOTOS` names a folder with one folder
of pictures per source; the hand before the desk of the data sets is one source more. Markers are drawn into the same.
"""

import argparse
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from bench.markers.scene import KINDS, Kind, camera_of, expose, make_scene
from bench.report import CALIBRATION, ROOT, Row, datasets, skipped
from common.arrays import Bool, Float, Image
from common.calibration import CameraCalibration, HsvRange, load
from common.errors import FitError
from common.geometry.srgb import gain_tables
from common.recording.frame_recording import open_recording
from common.sim.light import to_linear
from slave.markers.classify import ColourTable
from slave.markers.colours import calibrate, grow
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.quality import Evidence

PAINTED: Final = ("finger_end", "base", "noise", "blur3")  # kinds whose caps are drawn


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A photograph (H, W, 3) BGR without paint, and the set that it is from."""

    source: str
    image: Image


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """A photograph with caps."""

    kind: Kind  # whose caps they are; its camera finds them
    image: Image  # (H, W, 3) BGR
    uv: Float  # (M, 2) centroids [px]; NaN: not drawn
    radius: Float  # (M,) [px]


def photos() -> list[Photo]:
    """The photographs at hand, in a fixed order; none where there are no folders."""
    found: list[Photo] = []
    if root := os.environ.get("PHALANX_PHOTOS"):
        for folder in sorted(path for path in Path(root).iterdir() if path.is_dir()):
            found += _read(folder.name, sorted(folder.iterdir()))
    bare_every = 4  # of the pairs of a bare hand, which differ little
    return found + _read("bare_hand", sorted((datasets() / "real_bare_hand").glob("*.jpg"))[::bare_every])


def _read(source: str, files: list[Path]) -> list[Photo]:
    found: list[Photo] = []
    for file in files:
        image = cv2.imread(str(file))
        if image is not None:
            scale = 640 / image.shape[1]
            small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            found.append(Photo(source, np.ascontiguousarray(small, np.uint8)))
    return found


def painted(photo: Photo, rng: np.random.Generator) -> Painted:
    """Some of the caps of a generated hand on a photograph in place of a table."""
    height, width = photo.image.shape[:2]
    kind = replace(KINDS[PAINTED[rng.integers(len(PAINTED))]], size=(width, height))
    scene = make_scene(kind, rng)
    table = to_linear(photo.image[..., ::-1] / 255.0).astype(np.float32) / np.float32(scene.brightness)
    shown: list[int] = rng.permutation(len(scene.caps))[: rng.integers(1, len(scene.caps) + 1)].tolist()
    covered = 0.3  # share of the caps that something covers,
    hidden = 0.4  # and of such a cap, at most
    caps = list(scene.caps)
    for m, occluder in enumerate(scene.occluders):
        if rng.random() < covered:
            caps[m] = replace(caps[m], occluder=replace(occluder, share=rng.uniform(0.1, hidden)))
    light = replace(scene, table=table).light(tuple(caps[m] for m in shown))
    image = expose(light, kind.noise, rng)
    uv = np.full((len(caps), 2), np.nan)
    uv[shown] = [caps[m].visible[:2] for m in shown]
    radius = np.array([np.sqrt(cap.a * cap.b) for cap in caps])
    cut = 0.15  # share of the pictures that begin in a cap
    if rng.random() < cut:
        first = round(float(uv[shown[0], 0] + 0.5 * radius[shown[0]] * rng.uniform(-1.0, 1.0)))
        first = min(max(first, 0), 3 * width // 4)
        image, uv = np.ascontiguousarray(image[:, first:]), uv - (first, 0.0)
        kind = replace(kind, size=(width - first, height))
    return Painted(kind, image, uv, radius)


def as_by_another_camera(image: Image, rng: np.random.Generator) -> Image:
    """The picture under another exposure and white balance, with some haze, now and then as JPEG."""
    gains = np.exp(rng.normal(0.0, (0.08, 0.02, 0.08)) + rng.normal(0.0, 0.15))
    image = np.asarray(cv2.LUT(image, gain_tables(gains).T[None]), np.uint8)
    haze = rng.uniform(0.0, 0.15)
    image = np.asarray(cv2.addWeighted(image, 1.0 - haze, np.full_like(image, 160), haze, 0.0), np.uint8)
    if rng.random() < 0.5:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(70, 96))])[1]
        image = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return np.ascontiguousarray(image)


def halves(image: Image) -> Iterator[Image]:
    """Four overlapping parts of a picture, each scaled to its size: the same things, larger."""
    height, width = image.shape[:2]
    for v in (0, height // 3):
        for u in (0, width // 3):
            part = image[v : v + 2 * height // 3, u : u + 2 * width // 3]
            large = cv2.resize(part, (width, height), interpolation=cv2.INTER_CUBIC)
            yield np.ascontiguousarray(large, np.uint8)


SIX: Final = ("thumb", "index", "middle", "ring", "little", "back")
MARKED: Final = ROOT / "tests/golden/real_ball.json"
# Recording -> every n-th frame of it.
RENDERED: Final = {"lights_0_warm": 1, "flex90": 5, "translate_8ms": 5, "poses_left": 1}
# Where a person would click on the ball.
GREEN: Final = HsvRange(hsv_low=(38, 60, 20), hsv_high=(88, 255, 255))
FAMILIES: Final = ("painted", "rendered", "ball")  # of markers, which count alike


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """N detections."""

    evidence: Float  # (N, K) as of `Evidence`
    quality: Float  # (N,) by the detector
    right: Bool  # (N,) whether it is the marker
    source: tuple[str, ...]  # (N,) what it was found in
    photos: Mapping[str, int]  # source -> photographs without paint that were looked at

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

    def look_at_photo(self, photo: Photo, rng: np.random.Generator, *, enlarged: bool) -> None:
        """Look at a photograph without paint, and at it and its parts by other cameras; then paint it."""
        ranges = shipped()
        nowhere = np.zeros(len(ranges))
        self._photos[photo.source] = self._photos.get(photo.source, 0) + 1
        self.look(f"photo {photo.source}", photo.image, ranges, None, nowhere)
        if enlarged:
            for part in halves(photo.image):
                self.look(f"parts {photo.source}", as_by_another_camera(part, rng), ranges, None, nowhere)
        for _ in range(4):
            view = painted(photo, rng)
            image = as_by_another_camera(view.image, rng)
            of_kind = view.kind.camera.markers or {}
            named = {n: of_kind[n] for n in view.kind.names}
            self.look(f"painted {photo.source}", image, named, view.uv, view.radius)

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

    def look_at_ball(self, rng: np.random.Generator, clicks: int, *, other: bool) -> None:
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


def collected(rng: np.random.Generator, clicks: int, *, changed: bool) -> Rows:
    """Return everything found in photographs, with and without markers, in renderings and of the ball.

    `changed`: also in parts of the photographs, and of the ball as by other cameras: what weights are fitted to.
    """
    collector = Collector()
    for photo in photos():
        collector.look_at_photo(photo, rng, enlarged=changed)
    collector.look_at_rendered(rng)
    collector.look_at_ball(rng, clicks, other=changed)
    return collector.rows()


def fit(rows: Rows) -> Float:
    """Return bias and weights (1 + K,) of a logistic regression in which markers and others count alike.

    Newton's method (iteratively reweighted least squares; McCullagh and Nelder 1989, section 4.4), with a ridge.
    """
    x, y, weight = rows.evidence, rows.right.astype(np.float64), weights_of(rows)
    scale = np.maximum(x.std(axis=0), 1e-6)
    design = np.column_stack([np.ones(len(x)), x / scale])
    # In standard deviations of the evidence, against one detection.
    ridge = np.diag([0.0, *np.ones(x.shape[1])])
    beta = np.zeros(design.shape[1])
    for _ in range(30):
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
    return camera_of("photo", (image.shape[1], image.shape[0]), dict(ranges), 30.0)


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
                continue  # a person would click again
            found.append(calibrate(images[name], {"ball": click})[0].range)
    return found


_SET_BY_HAND = HsvRange(hsv_low=(45, 40, 25), hsv_high=(85, 255, 255))
_LIKELY = 0.5


def rows() -> Iterator[Row]:
    """Measure errors of the ball, false markers, and the reliability of quality."""
    cv2.setNumThreads(1)
    if not (datasets() / "real_ball").is_dir():
        yield skipped("real pictures", datasets())
        return
    seed = 7  # another than the weights were fitted with
    rng = np.random.default_rng(seed)
    clicked = clicked_ranges(*ball(), rng, 8)
    for name, ranges in (("colours by one click", clicked), ("range set by hand", [_SET_BY_HAND])):
        found = [ball_errors(one) for one in ranges]
        error, ratio, plain = (np.concatenate([f[k] for f in found]) for k in range(3))
        each = [float(np.nanmedian(f[0])) for f in found]
        note = f"each {min(each):.1f} to {max(each):.1f}; 95 % {np.nanpercentile(error, 95):.1f}"
        hsv = f"plain HSV {np.nanmedian(plain):.1f}; goal 2"
        share = 100.0 * float(np.isfinite(error).mean())
        yield Row(f"ball, {name}: centre is off by", float(np.nanmedian(error)), "px", f"{note}; {hsv}")
        note = f"95 % {np.nanpercentile(ratio, 95):.1f}; goal 3"
        yield Row(f"ball, {name}: in its sigma", float(np.nanmedian(ratio)), "sigma", note)
        yield Row(f"ball, {name}: found", share, "%", f"of {len(error)}")
    seen = collected(rng, 2, changed=False)
    plain_photo = np.array([source.startswith("photo ") for source in seen.source])
    count = max(sum(seen.photos.values()), 1)
    likely = float((seen.quality[plain_photo] > _LIKELY).sum()) / count
    every = float(plain_photo.sum()) / count
    yield Row("photographs: false markers", every, "each", f"of {count} photographs")
    yield Row(f"the same, of quality above {_LIKELY}", likely, "each", "goal 0.2")
    table = reliability(seen.quality, seen.right.astype(np.float64), weights_of(seen))
    for stated, right, share in table:
        yield Row(f"quality {stated:.2f}: is a marker", right, "share", f"{100.0 * share:.0f} % of all found")


def ball_errors(colour: HsvRange) -> tuple[Float, Float, Float]:
    """Return distances (N,) [px] from circles marked by eye, the same in sigma, and of plain HSV with the same range.

    Plain HSV: the centroid of the largest connected part of the mask.
    """
    marked, _ = ball()
    detector: MarkerDetector | None = None
    out: list[tuple[float, float, float]] = []
    for k, file in enumerate(sorted((datasets() / "real_ball").glob("*.jpg"))):
        image = np.asarray(cv2.imread(str(file)), np.uint8)
        if detector is None:
            detector = MarkerDetector(camera_for(image, {"ball": colour}), ("ball",))
        found = detector.push(image, k * 200_000_000)  # [ns]: every sixth frame of a video of 30 Hz
        if file.stem in marked:
            u, v, _ = marked[file.stem]
            away, plain = (float(np.hypot(*(uv - (u, v)))) for uv in (found.uv[0], _plain(image, colour)))
            out.append((away, away / float(found.sigma_px[0]), plain))
    error, ratio, plain = np.array(out).T
    return error, ratio, plain


def _plain(image: Image, colour: HsvRange) -> Float:
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    mask = cv2.inRange(hsv, np.array(colour.hsv_low), np.array(colour.hsv_high))
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask)
    if count < 2:
        return np.full(2, np.nan)
    return np.asarray(centres[1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))], np.float64)


def main(arguments: Sequence[str]) -> None:
    """Fit the weights of quality without the sources that are held out, and judge those."""
    parser = argparse.ArgumentParser(prog="python -m bench real_markers", description=__doc__)
    parser.add_argument("--fit", action="store_true", required=True, help="fit the weights of quality")
    parser.add_argument(
        "--held-out", default="", metavar="SOURCE,...", help="photographs to leave out of the fit"
    )
    held = set(parser.parse_args(arguments).held_out.split(",")) - {""}
    every = collected(np.random.default_rng(1), 6, changed=True)
    held_out = np.array([source.split()[-1] in held for source in every.source])
    beta = fit(every.of(~held_out))
    print(f"BIAS = {beta[0]:.2f}\nWEIGHTS = Evidence(")
    for name, weight in zip(Evidence._fields, beta[1:].tolist(), strict=True):
        print(f"    {name}={weight:.2f},")
    print(")")
    for title, chosen in (("fitted to", ~held_out), ("held out", held_out)):
        if chosen.any():
            part = every.of(chosen)
            p = 1.0 / (1.0 + np.exp(-np.clip(beta[0] + part.evidence @ beta[1:], -30.0, 30.0)))
            plain = np.array([source.startswith("photo ") for source in part.source])
            count = sum(n for source, n in every.photos.items() if (source in held) == (title == "held out"))
            false = (p[plain] > _LIKELY).sum() / max(count, 1)
            print(
                f"{title}: {len(p)} detections; {false:.2f} false (quality > 0.5) in each of {count} photographs"
            )
            for stated, found, share in reliability(p, part.right.astype(np.float64), weights_of(part)):
                print(f"  stated {stated:.2f}: right {found:.2f} ({100.0 * share:.0f} %)")
