"""Rows of entities as columns, a batch at a time.

A live viewer (2 or 3 poses a batch) and a file go the same way.
"""

from typing import cast

import numpy as np
import numpy.typing as npt
import rerun as rr

from common.arrays import Bool, Float, Int
from master.outputs.palette import Rgb
from master.outputs.rerun_blueprint import TIMELINE

PIXEL_CENTRE = 0.5  # Rerun: (0, 0) is the corner of the first pixel; here: its centre


class Columns:
    """Sender of rows to a recording, each at its `t_ns` on the timeline.

    The recording belongs to the caller.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording

    def send(self, path: str, t_ns: Int, columns: rr.ComponentColumnList, lengths: Int | None) -> None:
        """Send rows at `t_ns`.

        `lengths` (T,) instances each (0 clears the last row), None: one each.
        """
        index = rr.TimeColumn(TIMELINE, duration=cast("list[np.timedelta64]", t_ns.astype("timedelta64[ns]")))
        parts = columns if lengths is None else columns.partition(lengths)
        self._rec.send_columns(path, [index], parts)

    def points(
        self,
        path: str,
        t_ns: Int,
        at: Float,
        shown: Bool,
        colours: npt.NDArray[np.uint32],
        radii: Float | float,
    ) -> None:
        """Those of the points (T, N, 3) that are `shown` (T, N), in colours (T, N)."""
        each = np.broadcast_to(radii, shown.sum())
        columns = rr.Points3D.columns(positions=at[shown], colors=colours[shown], radii=each)
        self.send(path, t_ns, columns, shown.sum(axis=1))

    def pixels(
        self, path: str, t_ns: Int, uv: Float, colours: npt.NDArray[np.uint32], radius_px: float
    ) -> None:
        """Send those of the pixels (T, N, 2) that are not NaN, in colours (T, N).

        (0, 0) = centre of the first pixel.
        """
        shown = seen(uv)
        columns = rr.Points2D.columns(
            positions=uv[shown] + PIXEL_CENTRE,
            colors=colours[shown],
            radii=np.full(shown.sum(), radius_px),
        )
        self.send(path, t_ns, columns, shown.sum(axis=1))

    def rays(self, path: str, t_ns: Int, origin: Float, to: Float, colour: int) -> None:
        """Lines from `origin` (3,) to those of the points (T, N, 3) that are not NaN."""
        shown = seen(to)
        lines = [np.stack([origin, point]) for point in to[shown]]
        columns = rr.LineStrips3D.columns(
            strips=lines, radii=np.full(len(lines), 0.0003), colors=np.full(len(lines), colour, np.uint32)
        )
        self.send(path, t_ns, columns, shown.sum(axis=1))

    def lines(self, path: str, t_ns: Int, strips: Float, colour: int, radius_m: float) -> None:
        """One line a row through its points (T, K, 3); none where one of them is NaN."""
        shown = np.asarray(seen(strips).all(axis=1))
        columns = rr.LineStrips3D.columns(
            strips=list(strips[shown]),
            radii=np.full(shown.sum(), radius_m),
            colors=np.full(shown.sum(), colour, np.uint32),
        )
        self.send(path, t_ns, columns, np.asarray(shown, np.int64))

    def scalars(self, path: str, t_ns: Int, values: Float) -> None:
        """Send one number per row.

        NaN is sent as such: the viewer breaks the line there, and would bridge a missing row.
        """
        self.send(path, t_ns, rr.Scalars.columns(scalars=values), None)

    def name(self, path: str, name: str, rgb: Rgb) -> None:
        """Name and colour of a plotted line."""
        self._rec.log(path, rr.SeriesLines(names=name, colors=[rgb]), static=True)


def seen(points: Float) -> Bool:
    """Which of the points (..., D) are not NaN, (...)."""
    return np.asarray(~np.isnan(points).any(axis=-1), np.bool_)
