"""How far marker detectors are from the exact truth, kind by kind, ours and the published pipeline on the same frames.

`python -m bench.marker_accuracy [KIND ...] [--sequences N] [--seed S]` prints every kind at length.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from bench.marker_floor import floor_px
from bench.marker_kinds import KINDS
from bench.marker_score import FLAG_SIGMA_PX, Measurements, honesty, measure, score

GOALS: Final = {"base": 0.07, "finger_end": 0.10, "blur6": 0.12}
HIDDEN_GOAL: Final = 0.20
SEQUENCES: Final = {"base": 30, "finger_end": 30, "blur3": 20, "blur6": 20, "occluded15": 20, "320x240": 20}
LARGE: Final = 2  # sequences of the large sizes
TYPICAL_SEQUENCES: Final = 8
FLOOR_SEQUENCES: Final = 6


def rows() -> list[tuple[str, float, str, str]]:
    """Rows (name, value, unit, what it is held against)."""
    cv2.setNumThreads(1)
    out: list[tuple[str, float, str, str]] = []
    wrong = published_wrong = judged = 0
    for name, kind in KINDS.items():
        m = measure(kind, _count(name))
        out += rows_of(name, m)
        wrong += score(m.uv, m.truth, m.radius).wrong
        published_wrong += score(m.published, m.truth, m.radius).wrong
        judged += len(m.uv)
    out.append(
        ("all kinds: wrong blobs", wrong, "count", f"of {judged}; published {published_wrong}; goal 0")
    )
    return out


def rows_of(name: str, m: Measurements) -> list[tuple[str, float, str, str]]:
    """The rows of one kind."""
    ours, theirs = score(m.uv, m.truth, m.radius), score(m.published, m.truth, m.radius)
    hidden = KINDS[name].hidden > 0.0
    goal = f", goal {GOALS[name]}" if name in GOALS else ""
    floor = floor_px(KINDS[name], FLOOR_SEQUENCES) if name in GOALS and not hidden else np.array([])
    least = f", Cramer-Rao {np.sqrt(np.mean(np.square(floor))):.3f}" if floor.size else ""
    spread = f"median {ours.median_px:.3f}, 95 % {ours.p95_px:.3f}"
    within, ratio = honesty(m)
    flagged = 100.0 * float(m.flagged.mean())
    out: list[tuple[str, float, str, str]] = [
        (f"{name}: error per axis", ours.rms_px, "px RMS", f"published {theirs.rms_px:.3f}{goal}{least}; {spread}"),
        (f"{name}: found", 100.0 * ours.found, "%", f"of {ours.judged}; published {100.0 * theirs.found:.1f}"),
        (f"{name}: wrong blobs", ours.wrong, "count", f"published {theirs.wrong}"),
        (f"{name}: errors within 1.96 sigma", 100.0 * within, "%", f"honest 95; RMS of error/sigma {ratio:.2f}"),
        (f"{name}: flagged (sigma > {FLAG_SIGMA_PX} px)", flagged, "%", "" if hidden else "nothing is hidden"),
    ]  # fmt: skip
    if hidden:
        whole, theirs = score(m.uv, m.whole, m.radius), score(m.published, m.whole, m.radius)
        kept = ~m.flagged & np.isfinite(m.uv[:, 0])
        plain = score(m.uv[kept], m.whole[kept], m.radius[kept])
        out += [
            (f"{name}: error to the whole cap", whole.rms_px, "px RMS", f"published {theirs.rms_px:.3f}"),
            (
                f"{name}: the same, of those not flagged",
                plain.rms_px,
                "px RMS",
                f"goal {HIDDEN_GOAL}, or flagged",
            ),
        ]
    return out


def _count(name: str) -> int:
    return SEQUENCES.get(name, LARGE if KINDS[name].scale > 1.0 else TYPICAL_SEQUENCES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the rows of the kinds asked for, as each is done."""
    parser = argparse.ArgumentParser(prog="python -m bench.marker_accuracy", description=__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--sequences", type=int, help="of each kind (default: as in the benchmark)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    if unknown := sorted(set(options.kinds) - KINDS.keys()):
        parser.error(f"unknown kind {unknown[0]!r}; there are {', '.join(KINDS)}")
    cv2.setNumThreads(1)
    for name in options.kinds or KINDS:
        count = options.sequences or _count(name)
        for row in rows_of(name, measure(KINDS[name], count, options.seed)):
            print(f"  {row[0]:46s} {row[1]:8.3f} {row[2]:7s} {row[3]}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
