"""Markers in real pictures: a lit ball that a hand holds, and photographs without paint.

.venv/bin/python -m bench real_markers
.venv/bin/python -m bench.real_markers --picture out/ball.png
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from bench.marker_evidence import MARKED, Collector, Rows, ball, camera_for, clicked_ranges
from bench.marker_photos import DATASETS, photos
from bench.quality_fit import reliability, weights_of
from bench.real_markers_plot import draw
from common.arrays import Float, Image
from common.calibration import HsvRange
from slave.markers.detector import MarkerDetector

CLICKS: Final = 8
SEED: Final = 7  # another than the weights were fitted with
SET_BY_HAND: Final = HsvRange(hsv_low=(45, 40, 25), hsv_high=(85, 255, 255))
STEP_NS: Final = 200_000_000  # between two frames of the data set: every sixth of a video of 30 Hz
LIKELY: Final = 0.5

Row = tuple[str, float, str, str]


def rows() -> list[Row]:
    """Rows (name, value, unit, what it is held against)."""
    cv2.setNumThreads(1)
    if not (DATASETS / "real_ball").is_dir():
        return [("no data sets: set PHALANX_DATASETS", np.nan, "", "")]
    rng = np.random.default_rng(SEED)
    marked, images = ball()
    out: list[Row] = []
    clicked = clicked_ranges(marked, images, rng, CLICKS)
    for name, ranges in (("colours by one click", clicked), ("range set by hand", [SET_BY_HAND])):
        found = [ball_errors(one) for one in ranges]
        error, ratio, plain = (np.concatenate([f[k] for f in found]) for k in range(3))
        each = [float(np.nanmedian(f[0])) for f in found]
        spread = f"each {min(each):.1f} to {max(each):.1f}; " if len(each) > 1 else ""
        note = f"{spread}95 % {np.nanpercentile(error, 95):.1f}; plain HSV {np.nanmedian(plain):.1f}; goal 2"
        out += [
            (f"ball, {name}: centre is off by", float(np.nanmedian(error)), "px", note),
            (f"ball, {name}: in its sigma", float(np.nanmedian(ratio)), "sigma",
             f"95 % {np.nanpercentile(ratio, 95):.1f}; goal 3"),
            (f"ball, {name}: found", 100.0 * float(np.isfinite(error).mean()), "%", f"of {len(error)}"),
        ]  # fmt: skip
    seen = looked_at(rng)
    plain_photo = np.array([source.startswith("photo ") for source in seen.source])
    count = max(sum(seen.photos.values()), 1)
    likely = int((seen.quality[plain_photo] > LIKELY).sum())
    out += [
        ("photographs without paint: false markers", plain_photo.sum() / count, "each", f"of {count} photographs"),
        (f"the same, of quality above {LIKELY}", likely / count, "each", "goal 0.2"),
    ]  # fmt: skip
    for stated, right, share in table_of(seen):
        out.append(
            (f"quality {stated:.2f}: is a marker", right, "share", f"{100.0 * share:.0f} % of what is found")
        )
    return out


def ball_errors(colour: HsvRange) -> tuple[Float, Float, Float]:
    """Distances (N,) [px] from the circles marked by eye, the same in sigma, and of plain HSV with the same range.

    Plain HSV: the centroid of the largest connected part of the mask.
    """
    marked, _ = ball()
    files = sorted((DATASETS / "real_ball").glob("*.jpg"))
    detector: MarkerDetector | None = None
    rows_of: list[tuple[float, float, float]] = []
    for k, file in enumerate(files):
        image = np.asarray(cv2.imread(str(file)), np.uint8)
        if detector is None:
            detector = MarkerDetector(camera_for(image, {"ball": colour}), ("ball",))
        found = detector.push(image, k * STEP_NS)
        if file.stem in marked:
            u, v, _ = marked[file.stem]
            away = float(np.hypot(*(found.uv[0] - (u, v))))
            rows_of.append(
                (away, away / float(found.sigma_px[0]), float(np.hypot(*(_plain(image, colour) - (u, v)))))
            )
    error, ratio, plain = np.array(rows_of).T
    return error, ratio, plain


def looked_at(rng: np.random.Generator) -> Rows:
    """What is found in photographs, with and without paint, in renderings and of the ball."""
    collector = Collector()
    for photo in photos():
        collector.look_at_photo(photo, rng, enlarged=False)
    collector.look_at_rendered(rng)
    collector.look_at_ball(rng, 2, other=False)
    return collector.rows()


def table_of(seen: Rows) -> list[tuple[float, float, float]]:
    """The reliability table: markers and things that are none count alike."""
    return reliability(seen.quality, seen.right.astype(np.float64), weights_of(seen))


def _plain(image: Image, colour: HsvRange) -> Float:
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    mask = cv2.inRange(hsv, np.array(colour.hsv_low), np.array(colour.hsv_high))
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask)
    if count < 2:
        return np.full(2, np.nan)
    return np.asarray(centres[1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))], np.float64)


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw some frames of the ball with what was found."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.real_markers", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--picture", type=Path, required=True, metavar="FILE", help="PNG to write")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    rng = np.random.default_rng(SEED)
    marked, images = ball()
    colour = clicked_ranges(marked, images, rng, 1)[0]
    draw(options.picture, marked, images, colour)
    print(f"{options.picture}: circles of {MARKED.name}, and what is found with colours of one click")
    return 0


if __name__ == "__main__":
    sys.exit(main())
