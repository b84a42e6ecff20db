"""Plot of a guided motion: seen and fitted points.

From above and in the image.
"""

from pathlib import Path

import numpy as np

from common.geometry.camera_model import CameraModel
from master.calibrate.wrist.picture import BLUE, FINGER_COLOURS, GREY, figure_of, framed, saved
from master.calibrate.wrist.subject import Subject


def draw_subject(path: Path, found: Subject, optics: CameraModel) -> None:
    """Draw laser points, fingertips and knuckles, seen and fitted, as PNG.

    Laser points on their plane, fingertips and knuckles in the image; seen (dots) and fitted (rings).

    Raises:
        RecordingError: The file cannot be written.
    """
    model, fit, seen = found.model, found.fit, found.seen
    shown = model(fit.x, fit.angles_rad)
    used = np.isfinite(fit.off[..., 0])
    figure = figure_of((13.0, 5.6))
    figure.suptitle(found.report[0] + "; " + found.report[1])
    above, image = figure.subplots(1, 2)
    framed(image, optics, "fingertips (dots), as fitted (rings); knuckles, before (+) and after (x)")
    for f, colour in enumerate(FINGER_COLOURS[1:]):
        own = used[:, f]
        above.plot(*(1e3 * seen.laser_m[own, f]).T, ".", color=colour, markersize=4)
        above.plot(*(1e3 * shown[own, f, :2]).T, "o", color=colour, markerfacecolor="none", markersize=7)
        image.plot(*seen.tip_uv[own, f].T, ".", color=colour, markersize=5)
        tips = shown[own & np.isfinite(seen.tip_uv[:, f, 0]), f, 2:]
        image.plot(*tips.T, "o", color=colour, markerfacecolor="none", markersize=8)
    image.plot(*optics.project(model.knuckles(model.none)).T, "+", color=GREY, markersize=12)
    image.plot(*optics.project(model.knuckles(found.unknown)).T, "x", color=BLUE, markersize=10)
    above.set(title="laser points from above [mm]: dots seen, rings fitted", xlabel="across", ylabel="along")
    above.set_aspect("equal")
    saved(figure, path)
