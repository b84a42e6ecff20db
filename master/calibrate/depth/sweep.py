"""Depth sweep: one target at known distances, as both cameras of a pair saw it.

Also checks what makes a sweep unfit for a fit.

Refused is what would give a law that looks well and is not: see `checked`. Every refusal names the points and states
what to do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import FitError

RANGE = 2.5  # farthest over nearest distance; the paper has 5
FARTHEST_M = 10.0  # beyond it, 75 mm of baseline give less than 4 px: these are centimetres


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """N places of the target.

    Attributes:
        distance_m: (N,) of the target's centre along the first camera's axis [m].
        disparity_px: (N,) u of the first camera minus u of the second [px].
        uv: (2, N, 2) centroids [px], distorted images; NaN: only the disparity is known, or not seen.
        area_px2: (2, N) [px^2]; NaN: not known.
        sigma_px: (N,) standard deviation of one frame pair's disparity [px]; NaN: not known.
        frames: (N,) frame pairs that were averaged.
        place: (N,) where each point comes from, for messages: "line 5", "frame 12".
    """

    distance_m: Float
    disparity_px: Float
    uv: Float
    area_px2: Float
    sigma_px: Float
    frames: Int
    place: tuple[str, ...]

    @classmethod
    def of_disparity(cls, distance_m: Float, disparity_px: Float, place: Sequence[str]) -> "Sweep":
        """A sweep of which nothing but distances and disparities is known."""
        n = distance_m.size
        nan = np.full((2, n, 2), np.nan)
        return cls(
            distance_m, disparity_px, nan, nan[..., 0], nan[0, :, 0], np.ones(n, np.int64), tuple(place)
        )

    @property
    def size(self) -> int:
        """N."""
        return self.distance_m.size

    def at(self, chosen: Bool | Int) -> "Sweep":
        """The chosen places, by mask (N,) or by index (K,)."""
        index: Int = np.arange(self.size)[chosen]
        order: list[int] = index.tolist()
        return Sweep(
            self.distance_m[index],
            self.disparity_px[index],
            self.uv[:, index],
            self.area_px2[:, index],
            self.sigma_px[index],
            self.frames[index],
            tuple(self.place[i] for i in order),
        )

    def names(self, chosen: Bool | Int) -> str:
        """The chosen places in words: "0.45 m (line 12), 0.5 m (line 13)"."""
        index: list[int] = np.arange(self.size)[chosen].tolist()
        return ", ".join(f"{self.distance_m[i]:.4g} m ({self.place[i]})" for i in index)


def checked(sweep: Sweep, cameras: tuple[str, str], size_px: tuple[int, int] | None = None) -> Sweep:
    """The sweep by distance, nearest first, repeated distances averaged.

    Args:
        sweep: As measured.
        cameras: Names of the two cameras, for messages.
        size_px: Width and height of both images, where the sweep has centroids and areas.

    Raises:
        FitError: A target that is not seen, or partly outside an image; NaN; swapped cameras; a repeated distance
            that disagrees; too few points, too narrow or one-sided a range; disparities that do not fall with the
            distance.
    """
    merged = _merged(check_places(sweep, cameras, size_px))
    _check_falls(merged)
    check_enough(merged)
    return merged


def check_places(sweep: Sweep, cameras: tuple[str, str], size_px: tuple[int, int] | None = None) -> Sweep:
    """Sort the sweep by distance, nearest first, and check each place on its own.

    The target must be seen, be wholly in the image, and appear in the right order of cameras.

    Raises:
        FitError: As `checked`, without what concerns all places together.
    """
    _check_seen(sweep, cameras)
    _check_signs(sweep, cameras)
    if size_px is not None:
        _check_whole(sweep, cameras, size_px)
    return sweep.at(np.argsort(sweep.distance_m, kind="stable"))


def check_enough(sweep: Sweep) -> None:
    """Refuse points that do not determine a law over a range.

    Too few, too near each other, or all at one end.

    Raises:
        FitError: The message states what is missing.
    """
    # two constants, and enough points to distinguish a wrong one from the others; the paper has 17
    points = 8
    if sweep.size < points:
        raise FitError(
            f"{sweep.size} usable distances, {points} are needed and the published fit has 17: measure from 1.00 m"
            f" to 0.20 m in steps of 0.05 m"
        )
    near, far = float(sweep.distance_m.min()), float(sweep.distance_m.max())
    if far < RANGE * near:
        raise FitError(
            f"all distances lie within {near:.3g}...{far:.3g} m, the farthest must be {RANGE} times the nearest: a law"
            f" from a narrow range is wrong outside it; measure the whole range of use, such as 0.20...1.00 m"
        )
    middle = float(np.sqrt(near * far))
    nearer, farther = (
        int((sweep.distance_m < middle).sum()),
        int((sweep.distance_m > middle).sum()),
    )
    in_each_half = 2  # points nearer, and farther, than the geometric middle of the range
    if min(nearer, farther) < in_each_half:
        side, count = ("nearer", nearer) if nearer < farther else ("farther", farther)
        raise FitError(
            f"one-sided: only {count} of {sweep.size} distances is {side} than {middle:.3g} m (the geometric middle"
            f" of {near:.3g}...{far:.3g} m), {in_each_half} are needed: measure more that are {side}"
        )


def _check_seen(sweep: Sweep, cameras: tuple[str, str]) -> None:
    bad = ~((sweep.distance_m > 0.0) & (sweep.distance_m < FARTHEST_M))  # NaN too
    if bad.any():
        places = (
            "all places" if bad.all() else ", ".join(sweep.place[i] for i in np.flatnonzero(bad).tolist())
        )
        raise FitError(
            f"{places}: distance_m must be metres, above 0 and below {FARTHEST_M:g}: not centimetres or millimetres"
        )
    lost = np.isnan(sweep.disparity_px)
    if not lost.any():
        return
    for index, camera in enumerate(cameras):
        unseen = np.isnan(sweep.uv[index, :, 0]) & lost
        other = np.isfinite(sweep.uv[1 - index, :, 0])
        if (unseen & other).any():
            raise FitError(
                f"camera {camera!r} does not see the target at {sweep.names(unseen & other)}: it is outside that image,"
                " hidden, or not of the marker's colour; put it where both cameras see it, or leave the distance out"
            )
    raise FitError(f"no disparity at {sweep.names(lost)}: the target was not seen, or the value is NaN")


def _check_signs(sweep: Sweep, cameras: tuple[str, str]) -> None:
    wrong = sweep.disparity_px <= 0.0
    if wrong.sum() > sweep.size / 2:
        raise FitError(
            f"disparities u_{cameras[0]} - u_{cameras[1]} are not positive ({sweep.disparity_px[0]:.1f} px at"
            f" {sweep.distance_m[0]:.4g} m): left and right are swapped; the first camera must be the left one"
        )
    if wrong.any():
        raise FitError(
            f"disparities are not positive at {sweep.names(wrong)}: another thing of the marker's colour was taken for"
            " the target there; measure again or leave them out"
        )


def _check_whole(sweep: Sweep, cameras: tuple[str, str], size_px: tuple[int, int]) -> None:
    """Refuse targets that are cut by the border of an image.

    A cut target is too small for its distance, and its centroid lies inward.
    """
    nominal = sweep.area_px2 * sweep.distance_m**2
    if sweep.size == 0 or not np.isfinite(nominal).all():
        return
    typical = np.median(nominal, axis=1, keepdims=True)
    gap = np.minimum(sweep.uv, np.array(size_px) - 1.0 - sweep.uv).min(axis=2)
    # area x distance^2 of a target that faces the cameras is constant; a tilt by 30 deg costs 13 %
    whole = 0.85
    half_length = 0.62  # of the published target (75 x 50 mm), in square roots of its area
    cut = (nominal < whole * typical) & (gap < half_length * np.sqrt(typical) / sweep.distance_m)
    for index, camera in enumerate(cameras):
        if cut[index].any():
            raise FitError(
                f"the target is partly outside the image of camera {camera!r} at {sweep.names(cut[index])}: its area"
                " there is too small for the distance; put it where both cameras see all of it, or take a smaller one"
            )


def _merged(sweep: Sweep) -> Sweep:
    """Equal distances averaged; `sweep` is sorted by distance.

    Raises:
        FitError: Equal distances whose disparities differ by more than a ruler and noise explain.
    """
    same_m = 0.0005  # distances that a ruler does not distinguish
    group = np.concatenate([[0], np.cumsum(np.diff(sweep.distance_m) > same_m)]).astype(np.int64)
    parts: list[Sweep] = []
    for g in range(int(group[-1]) + 1 if sweep.size else 0):
        same = sweep.at(group == g)
        spread = float(np.ptp(same.disparity_px))
        x, d = float(same.disparity_px.mean()), float(same.distance_m.mean())
        ruler_m = 0.002  # to which a target can be put back to a mark
        disagree_px = 0.5  # five standard deviations of a disparity from two centroids of 0.07 px
        if spread > disagree_px + x * ruler_m / d:
            listed = ", ".join(
                f"{p}: {v:.2f} px" for p, v in zip(same.place, same.disparity_px.tolist(), strict=True)
            )
            raise FitError(
                f"the same distance {d:.4g} m was measured with disparities that disagree ({listed}): more than"
                f" {1e3 * ruler_m:.0f} mm on the ruler explain; measure it again or leave one out"
            )
        parts.append(same if same.size == 1 else _mean(same))
    return _joined(parts) if parts else sweep


def _mean(same: Sweep) -> Sweep:
    return Sweep(
        same.distance_m.mean(keepdims=True),
        same.disparity_px.mean(keepdims=True),
        same.uv.mean(axis=1, keepdims=True),
        same.area_px2.mean(axis=1, keepdims=True),
        same.sigma_px.mean(keepdims=True),
        same.frames.sum(keepdims=True),
        ("mean of " + ", ".join(same.place),),
    )


def _joined(parts: Sequence[Sweep]) -> Sweep:
    return Sweep(
        np.concatenate([part.distance_m for part in parts]),
        np.concatenate([part.disparity_px for part in parts]),
        np.concatenate([part.uv for part in parts], axis=1),
        np.concatenate([part.area_px2 for part in parts], axis=1),
        np.concatenate([part.sigma_px for part in parts]),
        np.concatenate([part.frames for part in parts]),
        tuple(name for part in parts for name in part.place),
    )


def _check_falls(sweep: Sweep) -> None:
    """Disparity must fall as the distance grows; `sweep` is sorted by distance."""
    rises = np.diff(sweep.disparity_px) >= 0.0
    if not rises.any():
        return
    if sweep.size > 2 and rises.all():
        raise FitError(
            "disparities grow with the distance: the distances stand in the reverse order of the frames (the published"
            " sweep runs 1.00:0.20:-0.05)"
        )
    pairs = ", ".join(
        f"{sweep.distance_m[i]:.4g} m {sweep.disparity_px[i]:.2f} px -> {sweep.distance_m[i + 1]:.4g} m"
        f" {sweep.disparity_px[i + 1]:.2f} px"
        for i in np.flatnonzero(rises).tolist()
    )
    raise FitError(
        f"not monotone: the disparity must fall as the distance grows, but {pairs}: a distance was noted wrongly, or"
        " something else was seen; measure these again or leave them out"
    )
