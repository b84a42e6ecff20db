"""Reading of a tag's code, with its fit to what is printed.

The corners of the tag are known to hundredths.

The light of every cell is compared with what each tag of the objects would show there, blurred as the tag's edges are:
by the correlation of the code's cells. So a tag is read though its cells are but two or three pixels wide and no bit of
it stands alone, and what is no tag correlates with none.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Ids, Image, Int
from common.calibration.object_profile import TagFamily
from common.geometry.tag_family import GRIDS, tag_bits
from slave.tags.corners import LIGHT, Corners, normal_law

SPOTS = np.array(
    [[0.0, 0.0], [-0.2, -0.2], [0.2, -0.2], [0.2, 0.2], [-0.2, 0.2]]
)  # of a cell, where it is looked at
SURE = {4: 0.97, 5: 0.88, 6: 0.82}  # cells of code -> correlation from which a tag is accepted
EXPECTED = {4: 0.8, 5: 0.7, 6: 0.6}  # and where it is expected


@dataclass(frozen=True, slots=True)
class Read:
    """What N quads are.

    Attributes:
        which: (N,) index of the tag that fits best.
        quarter_turns: (N,) which of the quad's corners is the first of the print.
        fit: (N,) correlation -1..1; NaN: the border is not black.
    """

    which: Int
    quarter_turns: Int
    fit: Float


class Codes:
    """The tags of one family that are sought. Holds their patterns.

    Attributes:
        family: Of them.
        ids: (K,) numbers, rising.
        cells: Along a side, the black border included.
        inner: (K, 4, cells) whether the cells behind the border are white, along the four sides, clockwise.
    """

    def __init__(self, family: TagFamily, numbers: Sequence[int]) -> None:
        """Seek `numbers`.

        Raises:
            ValueError: The family has no such tag.
        """
        self.family: TagFamily = family
        self.ids: Ids = np.array(sorted(numbers), np.uint16)
        code = GRIDS[family].cells
        self.cells = code + 2
        whole = np.array([np.pad(tag_bits(family, int(number)), 1) for number in self.ids], np.float64)
        # A quad that begins with corner t of the print shows the print turned t times anticlockwise.
        self._patterns = np.stack(
            [np.rot90(whole, quarter_turns, axes=(1, 2)) for quarter_turns in range(4)], axis=1
        )
        self.inner = np.stack([whole[:, 1], whole[:, :, -2], whole[:, -2, ::-1], whole[:, ::-1, 1]], axis=1)
        self.sure, self.expected = SURE[code], EXPECTED[code]

    def read(self, grey: Image, corners: Corners) -> Read:
        """Compare quads with all tags in all four turns."""
        n, m = len(corners.uv), self.cells
        seen = self._seen(grey, corners.uv)
        fits = np.empty((n, len(self.ids), 4))
        for k in range(n):
            x = corners.uv[k]
            side = max(1.0, float(np.linalg.norm(x - np.roll(x, 1, axis=0), axis=1).mean()))
            blur = _blur(m, corners.width_px[k] * m / side)
            shown = (blur @ self._patterns @ blur.T)[..., 1:-1, 1:-1].reshape(len(self.ids), 4, -1)
            fits[k] = _correlation(shown, seen[k, 1:-1, 1:-1].ravel())
        best = fits.reshape(n, -1).argmax(axis=1)
        fit = fits.reshape(n, -1)[np.arange(n), best]
        return Read(best // 4, (4 - best % 4) % 4, np.where(self._black(seen), fit, np.nan))

    def _seen(self, grey: Image, uv: Float) -> Float:
        """Linear light (N, cells, cells) of the cells of quads (N, 4, 2)."""
        m = self.cells
        at = (np.stack(np.meshgrid(np.arange(m), np.arange(m)), axis=-1)[:, :, None] + 0.5 + SPOTS).reshape(
            -1, 2
        )
        square = np.array([[0, 0], [m, 0], [m, m], [0, m]], np.float32)
        seen = np.empty((len(uv), m, m))
        for k, corners in enumerate(uv):
            to_image = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
            spots = cv2.perspectiveTransform(at[None], to_image)[0].astype(np.float32)
            bytes_ = cv2.remap(
                grey, spots[:, :1], spots[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            seen[k] = LIGHT[np.asarray(bytes_, np.uint8)].reshape(m, m, len(SPOTS)).mean(axis=-1)
        return seen

    def _black(self, seen: Float) -> Float:
        """Whether the border of each is black all round."""
        low, high = seen.min(axis=(1, 2)), seen.max(axis=(1, 2))
        border = np.concatenate([seen[:, 0], seen[:, -1], seen[:, 1:-1, 0], seen[:, 1:-1, -1]], axis=1)
        dark_border = 0.4  # of the way from black to white that no cell of the border may pass
        return border.max(axis=1) < low + dark_border * (high - low)


def _blur(cells: int, width: float) -> Float:
    """Return the blur matrix (cells, cells) of a row of cells.

    It holds the share that each cell has in the light at the middle of each other, blurred by `width` cells.
    """
    apart = (np.arange(cells)[:, None] - np.arange(cells)).astype(np.float64)
    width = max(width, 0.05)
    weight = normal_law((apart + 0.5) / width) - normal_law((apart - 0.5) / width)
    return weight / weight.sum(axis=1, keepdims=True)


def _correlation(shown: Float, seen: Float) -> Float:
    """Of patterns (..., C) with one that is seen (C,)."""
    a, b = shown - shown.mean(axis=-1, keepdims=True), seen - seen.mean()
    return (a @ b) / np.maximum(np.linalg.norm(a, axis=-1) * np.linalg.norm(b), 1e-12)
