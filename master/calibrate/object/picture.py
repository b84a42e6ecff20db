"""Plot of a measured object: its beads from three sides.

Also the residuals of each over time.
"""

from pathlib import Path

import numpy as np

from common.calibration.object_profile import ObjectProfile
from common.geometry.transforms import fit_rigid
from master.calibrate.object.measure import Measurement
from master.calibrate.wrist.picture import FINGER_COLOURS, GREY, figure_of, saved


def draw_object(path: Path, found: Measurement, profile: ObjectProfile) -> None:
    """Draw the beads with every observation, and the residuals over time, as PNG.

    Object frame, from above, ahead and aside; the residuals are distances left over time.

    Raises:
        RecordingError: The file cannot be written.
    """
    bundle, own = found.bundle, np.array([profile.markers[name].position_m for name in found.names])
    # Where each observation lies in the object: the bead less its residual, turned into its frame.
    rotation = fit_rigid(own, bundle.beads_m)[:3, :3]
    left = np.einsum("ij,tkj,tbk->tbi", rotation, bundle.T[:, :3, :3], bundle.off_m)
    figure = figure_of((16.0, 8.4))
    figure.suptitle(f"{profile.name}: {len(bundle.T)} epochs in {found.looks} ways of turning and places")
    *sides, time = figure.subplots(2, 2).ravel()
    for axes, (a, b) in zip(sides, ((0, 1), (0, 2), (1, 2)), strict=True):
        for row, name in enumerate(found.names):
            colour = FINGER_COLOURS[row % len(FINGER_COLOURS)]
            seen = 1e3 * (own[row] - left[:, row])
            axes.plot(seen[:, a], seen[:, b], ".", markersize=2, color=colour, alpha=0.5)
            axes.plot(*1e3 * own[row, [a, b]], "+", markersize=12, color="black")
            axes.annotate(name, 1e3 * own[row, [a, b]], textcoords="offset points", xytext=(6, 6))
        axes.set(title=f"object {'xyz'[a]}, {'xyz'[b]} [mm]")
        axes.set_aspect("equal", adjustable="datalim")
    for row, name in enumerate(found.names):
        colour = FINGER_COLOURS[row % len(FINGER_COLOURS)]
        size = 1e3 * np.linalg.norm(bundle.off_m[:, row], axis=1)
        outlier = bundle.outlier[:, row]
        time.plot(
            bundle.seen.t_s, np.where(outlier, np.nan, size), ".", markersize=3, color=colour, label=name
        )
        time.plot(bundle.seen.t_s[outlier], size[outlier], "x", markersize=4, color=GREY)
    time.set(title="from the rigid body [mm]; crosses: outliers", xlabel="time [s]")
    time.set_ylim(0.0, max(1.0, 1.2 * float(np.nanpercentile(1e3 * np.abs(bundle.off_m), 99.0)) * 1.7))
    time.legend(fontsize=8, markerscale=3)
    saved(figure, path)
