"""Separate the fingers of the LED image by seams, which never cross.

Seams of least energy by dynamic programming, as in Kim et al. 2012.

How the palm lies in the image is calibrated, and seen where the wrist is bent (`slave.wrist.palm_pose`), so what the
fingers of this hand can do sets the search band of each of the four seams (`slave.wrist.seams`). Along the
stations of a search band a seam is the path of least energy, found by dynamic programming: first the three among index
... little, side by side, then the thumb's, which lies over them where they meet. A pixel costs little where it is a
minimum, dark between brighter neighbours: a crease between touching fingers as well as the open gap between spread
ones, near the LEDs and far from them. The skin of a finger costs so much that no seam crosses one. Of paths alike the
one nearer to the middle of its band is taken: in an image that shows nothing the seams are those of the hand's
geometry alone.
"""

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from common.arrays import Float, Image, Int
from slave.wrist.engine import NUMPY, Engine
from slave.wrist.palm_pose import PalmPose, find_palm_pose
from slave.wrist.runs import NONE
from slave.wrist.seams import DARK, STARTS, STATION_PX, WIDTHS, Float32, SearchBands, search_bands_of
from slave.wrist.view import WristView

_TAKEN = 10.0  # energy for the thumb's seam where another seam runs
_HALF_WIDTH = 3.0  # samples of the thumb's search band: half the breadth of such a minimum
_CREASE = np.ones((5, 5), dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Fingers:
    """Five regions of the image: thumb, index ... little.

    Attributes:
        search_bands: Where the seams were searched.
        seams: (4, S) index|middle, middle|ring, ring|little [px, along the row of each station], and the thumb's
            [rad, along the circle of each station].
        shown: Whether the LED image showed a hand; else the seams are those of geometry alone.
        palm_pose: How the palm lies.
    """

    search_bands: SearchBands
    seams: Float
    shown: bool
    palm_pose: PalmPose

    def finger_of(self, uv: Float) -> Int:
        """Finger (N,), 0 thumb ... 4 little, of pixels (N, 2); -1 where the pixel is NaN."""
        search_bands = self.search_bands
        radius, angle = search_bands.polar(uv)
        steps: Float = STATION_PX * np.arange(self.seams.shape[1], dtype=np.float64)
        finger: Int = np.ones(len(uv), dtype=np.int64)
        across: list[Float] = [np.interp(uv[:, 1], search_bands.row + steps, seam) for seam in self.seams[:3]]
        for seam in across:
            finger += search_bands.thumb_side * (seam - uv[:, 0]) > 0.0
        finger[angle > np.interp(radius, search_bands.radius + steps, self.seams[3])] = 0
        finger[np.isnan(radius)] = NONE
        return finger

    def polylines(self) -> list[Float]:
        """The four seams as pixels (S, 2), for pictures."""
        return [self.search_bands.pixels(seam, self.seams[seam]) for seam in range(4)]


def separate(led: Image, view: WristView, engine: Engine = NUMPY) -> Fingers:
    """Find the seams in the difference of LED and ambient frame."""
    palm_pose = find_palm_pose(led, view)
    search_bands = search_bands_of(palm_pose.view)
    dark = cv2.erode(led, _CREASE)
    palm = dark[search_bands.palm[:, 1], search_bands.palm[:, 0]] if len(search_bands.palm) else dark
    # grey levels that the palm of a lit hand exceeds, or what hides it; the sun leaves less
    shown = bool(2 * np.count_nonzero(palm > 24) > palm.size)
    straightened = cast(
        Image,
        cv2.remap(
            dark, search_bands.map_x, search_bands.map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ),
    )
    energy = engine.energy(straightened, search_bands.thumb_crosses)
    energy[:, : STARTS[3]] *= search_bands.weight
    paths = engine.minimum_cost_paths(energy, WIDTHS)
    _part(paths[:3], straightened, energy, search_bands, engine)
    seams = search_bands.across(slice(0, 4), paths)
    # Towards the little finger, each seam stays on its own side of the one before it.
    order = search_bands.thumb_side
    np.minimum.accumulate(order * seams[:3], axis=0, out=seams[:3])
    seams[:3] *= order
    taken = _in_thumbs(search_bands, seams[:3])
    if (np.abs(paths[3] - taken) < _HALF_WIDTH).any():  # else it would pay nothing for what is taken
        thumb = energy[:, STARTS[3] :]
        thumb += _TAKEN * (np.abs(np.arange(WIDTHS[3]) - taken[..., None]) < _HALF_WIDTH).any(axis=0)
        seams[3:] = search_bands.across(slice(3, 4), engine.minimum_cost_paths(thumb, WIDTHS[3:]))
    return Fingers(search_bands, seams, shown, palm_pose)


def _part(
    paths: Int, straightened: Image, energy: Float32, search_bands: SearchBands, engine: Engine
) -> None:
    """Separate neighbouring seams that lie in one minimum.

    The one that is farther out of its search band is sent to another minimum.

    `paths` (3, S) and `energy` are changed.
    """
    lit = straightened[:, : STARTS[3]].max(axis=1) > DARK
    same_minimum = 0.35  # of the distance of two search bands, and of the rows of the hand
    near = same_minimum * np.abs(np.diff(search_bands.middle[:3], axis=0))
    most = same_minimum * np.count_nonzero(lit)
    for seam in range(2):
        across = search_bands.across(slice(0, 3), paths)
        same = (np.abs(np.diff(across, axis=0)) < near) & lit
        if not (same.sum(axis=1) >= most)[seam:].any():
            return
        if np.count_nonzero(same[seam]) < most:
            continue
        off = np.abs(paths[seam : seam + 2] - (WIDTHS[seam] - 1) / 2.0)[:, lit].sum(axis=1)
        loser = seam + int(off[1] > off[0])
        winner = 2 * seam + 1 - loser
        start = STARTS[loser]
        band_energy = energy[:, start : start + WIDTHS[loser]]
        at = search_bands.sample(loser, across[winner])
        band_energy += _TAKEN * (np.abs(np.arange(WIDTHS[loser]) - at[:, None]) < _HALF_WIDTH)
        paths[loser] = engine.minimum_cost_paths(band_energy, WIDTHS[loser : loser + 1])[0]


def _in_thumbs(search_bands: SearchBands, seams: Float) -> Float:
    """Return the sample (3, S) of the thumb's search band that each seam crosses.

    For each of three seams (3, S), at every circle.
    """
    count = seams.shape[1]
    steps = STATION_PX * np.arange(count, dtype=np.float64)
    rows = np.broadcast_to(search_bands.row + steps, seams.shape)
    radius, angle = search_bands.polar(np.stack([seams.ravel(), rows.ravel()], axis=-1))
    upward = radius.reshape(seams.shape)[:, ::-1], angle.reshape(seams.shape)[:, ::-1]
    circles = search_bands.radius + steps
    on_circles: list[Float] = [np.interp(circles, r, a) for r, a in zip(*upward, strict=True)]
    return search_bands.sample(3, np.array(on_circles))
