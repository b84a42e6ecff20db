"""`make bench`: prints the table of performance, section by section; `python -m bench NAME ...` runs some of them.

`python -m bench oracle --help`: two solvers on the same frozen messages. `python -m bench study --help`: the paper's
study repeated.
"""

import argparse
import importlib
import json
import math
import os
import platform
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from time import monotonic
from typing import cast

from bench.row import Row

SECTIONS = {
    "markers": "Marker detection, 640x480, six markers, one thread; baseline: the published pipeline rebuilt",
    "marker_accuracy": "Centroids on generated frames with exact truth, kind by kind; baseline: the published pipeline",
    "real_markers": "A real, lit ball in a hand, and photographs without paint (PHALANX_DATASETS, PHALANX_PHOTOS)",
    "tags": "Fiducial tags on generated frames with exact corners; baseline: cv2.aruco and its ways to refine",
    "steadiness": "Ten thousand frames through one detector: worst sort of frame, memory",
    "light": "Light that changes, standard scene, both cameras; baseline: the same detector with fixed colours",
    "filters": "1 euro filter: points, the hand at three settings, speed; baseline: one object per signal",
    "uncertainty": "95 % regions of markers: how often they hold the truth; rendered hands, a profile off by a tenth",
    "ik": "Inverse kinematics of fingers, palm known; baseline: the papers' FABRIK with limits, scipy, mink",
    "fabrik": "The card's line against the estimator, what each part costs, and its time; exact truth",
    "hand_poses": "Hands of independent joints, palm turned by up to 45 degrees; baseline: the papers' fixed palm",
    "hand": "A moving hand with its palm pose; baseline: the papers' fixed palm, scipy, mink",
    "real_motion": "Recorded and held hands through solver and filter; truth: the recording (PHALANX_DATASETS)",
    "mocap": "Poses against motion capture in another frame and clock; hands made from joints; exact truth, leapjs",
    "real_hands": "Real hands before ideal markers: grasping (PHALANX_MOTION), a glove with tips hidden; goals beside",
    "joint_covariance": "95 % regions of joints: how often they hold the truth, seen, hidden, gone; goal 95",
    "hidden_fingers": "Flexion and PIP of a finger without a marker, with its neighbours; baseline: alone",
    "pose_cost": "What a pose costs the master, stage by stage: two cameras, sixteen, fused; processor time",
    "fusion": "Markers and wrist device as one hand, against each alone; either cut off and back; exact truth",
    "fusion_cost": "Processor time of the fused line, message by message; baseline: each sensor alone",
    "orientation": "Palm and joints with one and three markers on the back, without and with an IMU; exact truth",
    "forearm": "Palm by an IMU on the forearm, with markers and without: heading, bend; simulated, exact truth",
    "imu": "Orientation by rates and forces; truth: BROAD (PHALANX_DATASETS), simulated arms; baseline: VQF",
    "master": "The master above the bus; and 16 cameras over sealed UDP",
    "sync": "Depth of a hand at 1 m/s from unsynchronised cameras, by rate, offset, motion; baseline: uncorrected",
    "depth": "Depth at rest, by fitted laws, and on recorded sweeps; baseline: the error budget",
    "wrist": "A strobed triple of the wrist device, step by step; baseline: undistorted images, a blob per finger",
    "wrist_strobe": "Triples of a stream of dropped, doubled and swapped frames; baseline: counting by three",
    "wrist_laser": "Laser points, recorded and simulated from dark to sun; baseline: the centroid of the blob",
    "wrist_tips": "Fingertips, recorded and simulated from dark to sun; exact truth, no baseline",
    "wrist_fingers": "Bends of fingers by a wrist device alone, by level and light; baseline: the printed cubic",
    "boards": "Lenses and places with a flat, a bent and the chosen board: exact truth; real pairs (PHALANX_DATASETS)",
    "wrist_calibration": "Laser plane by number of views, flat field, palm by board, who wears it; exact truth",
    "wrist_extrinsics": "How a wrist device sits, its clocks, from 10 s with markers: noisy, rendered; exact truth",
    "tracker": "A Vive tracker registered to the cameras from 12 s, and its clock; goal 3 mm, 2 deg; exact truth",
    "objects": "Objects of beads and of tags at half a metre, rendered, detected, partly hidden; goal 3 mm, 2 deg",
    "auxiliary_cost": "Processor time of objects, contact and gestures, pose by pose; baseline: the hand's fit",
    "watched_cost": "A master with console, recording and four outputs; baseline: the same process without",
    "recording": "Raw frames to disk; baseline: PNG of level 1, and encoding and writing in the camera loop",
    "occlusion": "Finger tips that no two cameras see, in six poses: two pairs of cameras; baseline: one pair",
    "gesture_poses": "The six study poses: simulated people, rendered frames, handy_poses, leapjs; exact truth",
    "gestures": "Pinch, dial, taps, pointing: late, wrong, false; two marker rigs, fused, silent hands; exact truth",
    "volume": "A finger tip in 27 places of the volume that the rig desk states; exact truth, no baseline",
    "replay": "Recorded frames with exact truth (PHALANX_DATASETS); exact truth, no baseline",
    "live": "Two slaves and the master over real UDP, standard scene; baseline: an idle relay of datagrams",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sections asked for, or oracle or study with their own options; return the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] in (["oracle"], ["study"]):  # with options of their own
        return int(importlib.import_module(f"bench.{given[0]}").main(given[1:]))
    sections = "\n".join(f"  {name:18s} {what}" for name, what in SECTIONS.items())
    parser = argparse.ArgumentParser(
        prog="python -m bench",
        description=__doc__,
        epilog=f"sections:\n{sections}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("sections", nargs="*", metavar="SECTION", help="one of those below (default: all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to FILE as well")
    options = parser.parse_args(given)
    wanted = cast(list[str], options.sections) or list(SECTIONS)
    if unknown := sorted(set(wanted) - SECTIONS.keys()):
        parser.error(f"unknown section {unknown[0]!r}; there are {', '.join(SECTIONS)}")
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    everything: dict[str, list[Row]] = {}
    for name in wanted:
        print(f"\n{SECTIONS[name]}", flush=True)
        start_s, everything[name] = monotonic(), []
        section = importlib.import_module(f"bench.{name}")
        for found in cast(Iterable[Row], section.rows()):
            row = Row(*found)
            everything[name].append(row)
            print(f"  {row.name:58s} {_number(row.value):>10s} {row.unit:8s} {row.note}", flush=True)
        print(f"  ({monotonic() - start_s:.0f} s)", flush=True)
        if figures := cast(dict[str, str], getattr(section, "FIGURES", {})):
            values = {row.name: row.value for row in everything[name]}
            print(json.dumps({key: round(values[row], 4) for key, row in figures.items()}), flush=True)
    if options.json is not None:
        tables = {name: [_plain(row) for row in rows] for name, rows in everything.items()}
        options.json.write_text(json.dumps(tables, indent=1, allow_nan=False))
    return 0


def _plain(row: Row) -> dict[str, object]:
    """A row for JSON, which has no number for what could not be measured."""
    value = float(row.value) if math.isfinite(row.value) else None
    return {"name": row.name, "value": value, "unit": row.unit, "note": row.note}


def _number(value: float) -> str:
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


if __name__ == "__main__":
    sys.exit(main())
