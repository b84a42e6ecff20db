"""Markers in real pictures: a lit ball that a hand holds, and photographs without markers.

python -m bench real_markers                                     with PHALANX_DATASETS, perhaps PHALANX_PHOTOS
python -m bench real_markers --fit [--held-out SOURCE,...]       weights for slave/markers/quality.py
"""

import argparse
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from bench.markers.evidence import (
    Collector,
    Rows,
    ball,
    camera_for,
    clicked_ranges,
    collected,
    fit,
    reliability,
    weights_of,
)
from bench.markers.photos import photos
from bench.report import Row, datasets, skipped
from common.arrays import Float, Image
from common.calibration import HsvRange
from slave.markers.detector import MarkerDetector
from slave.markers.quality import Evidence

_CLICKS = 8
SEED = 7  # another than the weights were fitted with
_SET_BY_HAND = HsvRange(hsv_low=(45, 40, 25), hsv_high=(85, 255, 255))
_STEP_NS = 200_000_000  # between two frames of the data set: every sixth of a video of 30 Hz
_LIKELY = 0.5


def rows() -> Iterator[Row]:
    """Measure errors of the ball, false markers, and the reliability of quality."""
    cv2.setNumThreads(1)
    if not (datasets() / "real_ball").is_dir():
        yield skipped("real pictures", datasets())
        return
    rng = np.random.default_rng(SEED)
    clicked = clicked_ranges(*ball(), rng, _CLICKS)
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
    seen = looked_at(rng)
    plain_photo = np.array([source.startswith("photo ") for source in seen.source])
    count = max(sum(seen.photos.values()), 1)
    likely = float((seen.quality[plain_photo] > _LIKELY).sum()) / count
    yield Row(
        "photographs: false markers", float(plain_photo.sum()) / count, "each", f"of {count} photographs"
    )
    yield Row(f"the same, of quality above {_LIKELY}", likely, "each", "goal 0.2")
    for stated, right, share in table_of(seen):
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
        found = detector.push(image, k * _STEP_NS)
        if file.stem in marked:
            u, v, _ = marked[file.stem]
            away, plain = (float(np.hypot(*(uv - (u, v)))) for uv in (found.uv[0], _plain(image, colour)))
            out.append((away, away / float(found.sigma_px[0]), plain))
    error, ratio, plain = np.array(out).T
    return error, ratio, plain


def looked_at(rng: np.random.Generator) -> Rows:
    """Return everything found in photographs, with and without markers, in renderings and of the ball."""
    collector = Collector()
    for photo in photos():
        collector.look_at_photo(photo, rng, enlarged=False)
    collector.look_at_rendered(rng)
    collector.look_at_ball(rng, 2, other=False)
    return collector.rows()


def table_of(seen: Rows) -> list[tuple[float, float, float]]:
    """Return the reliability table: markers and other things count alike."""
    return reliability(seen.quality, seen.right.astype(np.float64), weights_of(seen))


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
    every = collected()
    apart = np.array([source.split()[-1] in held for source in every.source])
    beta = fit(every.of(~apart))
    print(f"BIAS = {beta[0]:.2f}\nWEIGHTS = Evidence(")
    for name, weight in zip(Evidence._fields, beta[1:].tolist(), strict=True):
        print(f"    {name}={weight:.2f},")
    print(")")
    for title, chosen in (("fitted to", ~apart), ("held out", apart)):
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
