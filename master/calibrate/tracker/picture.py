"""Plot of a registration: the object's path by cameras and by tracker.

Also the residuals over time.
"""

from pathlib import Path

import numpy as np

from master.calibrate.tracker.registration import Registration
from master.calibrate.wrist.picture import BLUE, GREY, ORANGE, figure_of, saved

_GREEN = "#2f855a"


def draw_registration(path: Path, found: Registration) -> None:
    """Draw the object's path and the offsets of position and rotation, as PNG.

    From above and from the side (dots: cameras; lines: tracker); offsets over time.

    Raises:
        RecordingError: The file cannot be written.
    """
    fit = found.fit
    figure = figure_of((17.0, 8.4))
    figure.suptitle("\n".join(found.report[:2]))
    above, side, place, rotation = figure.subplots(2, 2).ravel()
    seen = 1e3 * (fit.p_m + fit.off[:, :3])
    track_mm = 1e3 * fit.p_m.copy()
    track_mm[np.diff(fit.t_s, prepend=fit.t_s[0]) > 0.2] = np.nan  # a gap is no way
    for axes, (a, b), title in (
        (above, (0, 2), "from above [mm]"),
        (side, (2, 1), "from the side [mm]"),
    ):
        axes.plot(track_mm[:, a], track_mm[:, b], "-", color=GREY, linewidth=0.8, label="tracker")
        axes.plot(
            seen[~fit.outlier, a], seen[~fit.outlier, b], ".", color=BLUE, markersize=3, label="cameras"
        )
        axes.plot(
            seen[fit.outlier, a], seen[fit.outlier, b], "x", color=ORANGE, markersize=4, label="outlier"
        )
        axes.set(title=f"{title}: rig {'xyz'[a]}, {'xyz'[b]}")
        axes.set_aspect("equal", adjustable="datalim")
        axes.legend(fontsize=8)
    side.invert_yaxis()  # y of the rig points down
    for axes, columns, unit, title in (
        (place, slice(0, 3), 1e3, "cameras against tracker: place [mm]"),
        (rotation, slice(3, 6), np.degrees(1.0), "cameras against tracker: turn [deg]"),
    ):
        left = unit * np.where(fit.outlier[:, None], np.nan, fit.off[:, columns])
        for values, colour, name in zip(left.T, (BLUE, ORANGE, _GREEN), "xyz", strict=True):
            axes.plot(fit.t_s, values, ".", color=colour, markersize=3, label=name)
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        axes.set(title=title, xlabel="time [s]")
        axes.legend(fontsize=8)
    saved(figure, path)
