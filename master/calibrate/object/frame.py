"""Frame in which the positions of beads are written.

The object's own, by the beads, or that of an existing file.
"""

import numpy as np

from common.arrays import Float
from common.calibration.object_profile import ObjectProfile
from common.errors import FitError
from common.geometry.transforms import fit_rigid, rigid, transform

LINE_M = 5e-3  # from the line through the first two beads; nearer, they do not determine how it is turned about that
OWN = (
    "origin in the middle of the beads, x from the first to the second, y to the side of the one farthest from that"
    " line"
)


def own_frame(beads_m: Float, names: tuple[str, ...]) -> Float:
    """Return `T_own_body` (4, 4) for beads (B, 3) [m].

    Axes as `OWN` defines; z is x times y.

    Raises:
        FitError: The beads lie in one line.
    """
    x = beads_m[1] - beads_m[0]
    length = float(np.linalg.norm(x))
    x = x / max(length, 1e-9)
    aside = (beads_m - beads_m[0]) - np.outer((beads_m - beads_m[0]) @ x, x)
    far = np.linalg.norm(aside, axis=1)
    if length < LINE_M or far.max() < LINE_M:
        raise FitError(
            f"{', '.join(names)} lie in one line (all within {1e3 * float(far.max()):.1f} mm of it): how the object is"
            f" turned about it nobody can see. Put one bead aside, by {1e3 * LINE_M:.0f} mm at least"
        )
    y = aside[int(np.argmax(far))] / far.max()
    R = np.stack([x, y, np.cross(x, y)])
    return rigid(R, -R @ beads_m.mean(axis=0))


def frame_of(
    beads_m: Float, names: tuple[str, ...], like: ObjectProfile, where: str
) -> tuple[Float, dict[str, float]]:
    """Return `T_file_body` (4, 4), the best fit of beads (B, 3) to those of a file.

    Also by how much each bead misses [m].

    Raises:
        FitError: The file has fewer than three of them, in one line, or they lie elsewhere.
    """
    shared = [row for row, name in enumerate(names) if name in like.markers]
    there = np.array([like.markers[names[row]].position_m for row in shared]).reshape(-1, 3)
    spread = np.linalg.svd(there - there.mean(axis=0), compute_uv=False) if len(shared) > 2 else np.zeros(3)
    if len(shared) < 3 or spread[1] < LINE_M:
        raise FitError(
            f"{where}: has {len(shared)} of the beads {', '.join(names)}; its frame needs three not collinear"
        )
    T = fit_rigid(there, beads_m[shared])
    off = np.linalg.norm(transform(T, beads_m[shared]) - there, axis=1)
    misses = {names[row]: float(miss) for row, miss in zip(shared, off, strict=True)}
    worst = max(misses, key=lambda name: misses[name])
    like_m = 0.015  # by which beads may lie elsewhere than in the file that the frame is taken from
    if misses[worst] > like_m:
        raise FitError(
            f"{where}: {worst} lies {1e3 * misses[worst]:.0f} mm from where the file has it: its frame cannot be"
            " kept. Are the names in the order of the beads? Else give it a frame of its own: another name, no --like"
        )
    return T, misses
