"""Reliability diagrams: what is stated against what is found, of markers, joints and IMU.

    python -m bench reliability --picture docs/images/reliability.png

Markers: of all that is found with about a quality, the share that is a marker. Joints and IMU: of all regions of a
probability, the share that the truth lies in; below the diagonal is too sure. PHALANX_DATASETS, and where they are
yours PHALANX_PHOTOS and PHALANX_MOTION, are folders as in `bench.markers.photos` and `bench.hands.grasping`;
parts left out for want of them are named.
"""

import argparse
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from matplotlib.axes import Axes
from scipy.stats import chi2

from bench import imu
from bench.hands import certainty, grasping
from bench.markers import real
from bench.report import COLOURS, datasets, figure
from common.arrays import Float
from common.calibration import HandProfile, load

LEVELS: Final = np.linspace(0.0, 1.0, 101)
_SEEDS: Final = certainty.SEEDS[:2]


def found_in(chi_2: Float, degrees: int) -> Float:
    """Share (101,) of chi squares (N,) within the regions of the probabilities `LEVELS`."""
    stated = np.sort(chi2.cdf(chi_2, degrees))
    return np.searchsorted(stated, LEVELS, side="right") / len(stated)


def joints() -> dict[str, Float]:
    """Chi squares of joints, by what was looked at."""
    profile = load(certainty.HAND, HandProfile)
    parts: dict[str, list[certainty.Coverage]] = {}
    for seed in _SEEDS:
        for _, model, motion in certainty.motions(profile, seed):
            run = certainty.compared(model, motion, certainty.NOISE_M["1 mm"], seed)
            for kind, some in certainty.kinds(run):
                parts.setdefault(kind, []).append(some)
    out = {
        f"simulated, {kind}": certainty.joined(parts[kind]).chi_2
        for kind in ("visible", "hidden up to 300 ms")
    }
    if files := grasping.motion_files():
        grasps = [grasping.grasped(path, 1, half=True).chi2[:, 1:, 1] for path in files]
        out["real grasping, PIP joints"] = np.concatenate([chi_2.ravel() for chi_2 in grasps])
    if (glove := grasping.glove()) is not None:
        _, hidden, seen = grasping.hidden_tip(*glove, 0, 0.3)
        out["real glove, thumb tip hidden"], out["real glove, tips that are seen"] = hidden, seen
    return out


def tilts() -> dict[str, Float]:
    """Chi squares of the inclination of recorded IMUs, by recording."""
    out: dict[str, Float] = {}
    for name, recording in imu.recorded().items():
        errors = imu.tilt_errors(*imu.stated(recording), recording)
        squares: Float = np.vecdot(errors.error_rad, errors.error_rad)
        out[name.replace("undisturbed_", "").replace("_", " ")] = squares / np.square(errors.sigma_rad)
    return out


def draw(
    file: Path,
    markers: Sequence[tuple[float, float, float]],
    hand: Mapping[str, Float],
    level: Mapping[str, Float],
) -> None:
    """Write the three diagrams as a PNG.

    Args:
        file: To write.
        markers: (stated, right, share of all) of each bin.
        hand, level: Chi squares of three and two degrees of freedom, by name.

    Raises:
        OSError: The file cannot be written.
    """
    made = figure(13.0, 4.6)
    panels = made.subplots(1, 3)
    stated, right, share = np.array(markers).T
    panels[0].bar(stated, share, 0.06, color="#c9d8e3", label="share of all that is found")
    panels[0].plot(stated, right, "o-", color=COLOURS[0], linewidth=1.4, label="is a marker")
    _finish(panels[0], "Markers", "stated quality", "share")
    for axes, title, chi_2s, degrees in (
        (panels[1], "Joints", hand, 3),
        (panels[2], "IMU, inclination", level, 2),
    ):
        for (name, chi_2), colour in zip(chi_2s.items(), COLOURS, strict=False):
            axes.plot(LEVELS, found_in(chi_2, degrees), color=colour, linewidth=1.4, label=name)
        _finish(axes, title, "stated probability of the region", "share of truths in it")
    file.parent.mkdir(parents=True, exist_ok=True)
    made.savefig(file)


def _finish(axes: Axes, title: str, stated: str, found: str) -> None:
    axes.plot([0.0, 1.0], [0.0, 1.0], color="#999999", linewidth=1.0, linestyle="--")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(stated, fontsize=9)
    axes.set_ylabel(found, fontsize=9)
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.03)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, frameon=False, loc="best")


def main(arguments: Sequence[str]) -> None:
    """Measure and draw."""
    parser = argparse.ArgumentParser(
        prog="python -m bench reliability", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--picture", type=Path, required=True, metavar="FILE", help="PNG to write")
    options = parser.parse_args(arguments)
    if not (datasets() / "real_ball").is_dir():
        parser.error(f"no data sets at {datasets()}: set PHALANX_DATASETS")
    for folder, what in (("PHALANX_PHOTOS", "your photographs"), ("PHALANX_MOTION", "grasping")):
        if folder not in os.environ:
            print(f"left out: {what}, for {folder} is not set")
    cv2.setNumThreads(1)
    markers = real.table_of(real.looked_at(np.random.default_rng(real.SEED)))
    draw(options.picture, markers, joints(), tilts())
    print(f"{options.picture}: stated against found, of markers, joints and IMU")
