"""Benchmarks: `python -m bench NAME ...`; without a name all that print rows, one after another (`make bench`).

`python -m bench NAME --help` shows the options of those that have their own.
"""

import argparse
import importlib
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from time import monotonic
from typing import Any, cast

from bench.report import Row, machine, show, write_json

# Group -> name -> (module, what it measures). A module has `rows()`, or its own command line `main(arguments)`.
COMMANDS: dict[str, dict[str, tuple[str, str]]] = {
    "markers": {
        "markers": ("markers.speed", "time of detection, six markers; baseline: the published pipeline"),
        "marker_accuracy": ("markers.accuracy", "centroids on generated frames, kind by kind"),
        "real_markers": (
            "markers.real",
            "a real ball in a hand, photographs without markers (PHALANX_PHOTOS)",
        ),
    },
    "hand": {
        "ik": ("hands.ik", "fingers of a known palm; baseline: the papers' FABRIK with limits, scipy"),
        "hand_poses": ("hands.poses", "random independent joints, palm turned; baseline: the papers'"),
        "real_motion": ("hands.motion", "recorded and held hands through solver and filter"),
        "real_hands": (
            "hands.grasping",
            "captured hands before ideal markers (PHALANX_MOTION); a hidden tip",
        ),
        "joint_certainty": ("hands.certainty", "95 % regions of joints that are seen, hidden, gone"),
        "hand_lengths": ("hands.lengths", "fingers by the routine of `calibrate hand`, simulated users"),
        "mocap": ("hands.mocap", "poses against motion capture in another frame and clock"),
        "imu": ("imu", "orientation by rates and forces (BROAD); baseline: VQF"),
    },
    "cameras": {
        "sync": ("cameras.sync", "depth of a hand at 1 m/s from unsynchronised cameras"),
        "depth": ("cameras.depth", "depth of a hand at rest"),
        "uncertainty": ("cameras.uncertainty", "95 % regions of markers, rendered hands with wrong radii"),
        "occlusion": ("cameras.occlusion", "finger tips that no two cameras see"),
    },
    "wrist device": {
        "wrist_strobe": ("wrist.strobe", "strobe cycles of a stream of dropped, doubled, swapped frames"),
        "wrist_tips": ("wrist.tips", "fingertips, recorded and simulated from dark to sun"),
        "wrist_fingers": ("wrist.fingers", "joint angles by the device alone, by level and light"),
        "wrist_calibration": ("wrist.calibration", "laser plane by views, palm and knuckles of a subject"),
    },
    "hand, objects and gestures": {
        "fusion": ("both.fusion", "markers and wrist device as one hand, against each alone"),
        "gesture_poses": ("gestures.poses", "the six study poses: people before rigs"),
        "gestures": ("gestures.actions", "pinch, dial, taps, pointing: late, missed, false"),
        "objects": ("objects.tracked", "objects of beads and of tags, rendered, detected, partly hidden"),
        "tags": ("objects.tags", "fiducial tags on generated frames; baseline: cv2.aruco"),
        "tracker": ("objects.tracker", "a Vive tracker registered to the cameras from 12 s"),
        "study": ("study.command", "the study of Digits: simulated people, six poses, open loop"),
    },
    "cost": {
        "pose_cost": ("pose_cost", "processor time of a pose, stage by stage; ends with a line of JSON"),
    },
    "processes": {
        "scale": ("rigs.scale", "2 to 16 cameras: cost, loss, latency"),
        "soak": ("rigs.soak", "an hour of a whole rig: memory, latency, loss"),
    },
    "guards": {
        "oracle": ("oracle.command", "frozen recordings with exact truth; one solver against another"),
    },
}
ALL = {name: entry for group in COMMANDS.values() for name, entry in group.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run benchmarks by name; return the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in ALL and _own_options(module := _module(given[0]), given[1:]):
        return int(module.main(given[1:]) or 0)
    groups = ""
    for group, known in COMMANDS.items():
        groups += f"{group}:\n" + "".join(f"  {name:18s} {what}\n" for name, (_, what) in known.items())
    keep = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m bench", None, __doc__, groups, formatter_class=keep)
    parser.add_argument("names", nargs="*", metavar="NAME", help="of those below (default: all with rows)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to FILE as well")
    options = parser.parse_args(given)
    names = cast(list[str], options.names) or [name for name in ALL if hasattr(_module(name), "rows")]
    if unknown := sorted(set(names) - ALL.keys()):
        parser.error(f"unknown benchmark {unknown[0]!r}; there are {', '.join(ALL)}")
    print("{machine}, {cores} cores, Python {python}".format(**machine()))
    tables: dict[str, list[Row]] = {}
    for name in names:
        print(f"\n{name}: {ALL[name][1]}", flush=True)
        start_s, section = monotonic(), _module(name)
        tables[name] = show(Row(*found) for found in cast(Iterable[Row], section.rows()))
        print(f"  ({monotonic() - start_s:.0f} s)", flush=True)
        if figures := cast(dict[str, str], getattr(section, "FIGURES", {})):
            values = {row.name: row.value for row in tables[name]}
            print(json.dumps({key: round(values[row], 4) for key, row in figures.items()}), flush=True)
    if options.json is not None:
        write_json(options.json, tables)
    return 0


def _own_options(module: Any, rest: Sequence[str]) -> bool:
    """Whether a benchmark reads its own command line: it has no rows, or is given more than ours."""
    ours = not rest or rest[0] in (*ALL, "--json")
    return hasattr(module, "main") and not (hasattr(module, "rows") and ours)


def _module(name: str) -> Any:
    return importlib.import_module(f"bench.{ALL[name][0]}")


if __name__ == "__main__":
    sys.exit(main())
