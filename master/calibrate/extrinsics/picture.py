"""Plot of a mounting: laser points and tips, seen and fitted.

Also how the wrist was flexed meanwhile.
"""

from pathlib import Path

import numpy as np

from common.geometry.camera_model import CameraModel
from master.calibrate.extrinsics.extrinsics import Extrinsics
from master.calibrate.wrist.picture import BLUE, FINGER_COLOURS, GREY, ORANGE, figure_of, framed, saved


def draw_extrinsics(path: Path, found: Extrinsics, optics: CameraModel) -> None:
    """Draw observed and fitted points of a mounting, and the wrist over time, as PNG.

    Laser points on their plane and fingertips in the image, seen (dots) and fitted (rings).

    Raises:
        RecordingError: The file cannot be written.
    """
    fit, cycles = found.fit, found.cycles
    seen = fit.shown + fit.off * fit.sigma  # tips as they were when the laser shone
    figure = figure_of((17.0, 5.4))
    figure.suptitle(found.report[0] + "; " + found.report[1])
    above, image, wrist = figure.subplots(1, 3)
    framed(image, optics, "fingertips (dots), as fitted (rings)")
    for f, colour in enumerate(FINGER_COLOURS[1:]):
        lit, tipped = (np.isfinite(fit.off[:, f, k]) for k in (0, 2))
        above.plot(*(1e3 * seen[lit, f, :2]).T, ".", color=colour, markersize=4)
        above.plot(*(1e3 * fit.shown[lit, f, :2]).T, "o", color=colour, markerfacecolor="none", markersize=7)
        image.plot(*seen[tipped, f, 2:].T, ".", color=colour, markersize=5)
        image.plot(*fit.shown[tipped, f, 2:].T, "o", color=colour, markerfacecolor="none", markersize=8)
    above.set(title="laser points from above [mm]: dots seen, rings fitted", xlabel="across", ylabel="along")
    above.set_aspect("equal")
    for values, colour, name in (
        (fit.wrist_angles_rad[:, 0], BLUE, "flexion"),
        (fit.wrist_angles_rad[:, 1], ORANGE, "deviation"),
        (fit.twist_rad, GREY, "twist, which no wrist has"),
    ):
        wrist.plot(cycles.t_s, np.degrees(values), ".", color=colour, label=name)
    wrist.set(title="the wrist [deg]", xlabel="time [s]")
    wrist.legend(fontsize=8)
    saved(figure, path)
