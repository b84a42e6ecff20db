"""Assignment of marker colours to markers.

It is by the shape of the hand, by an older calibration, or by clicks.

By the hand: an open hand seen from its back is a turned, scaled picture of the profile's flat hand. In every frame
that shows all marker colours, or all but one, all orders of names are fitted (a similarity without reflection,
least squares in the complex plane); a frame where one order fits well, and clearly better than every other, votes
for it. A frame that fits the mirrored hand better votes against the side of the profile.

By a camera file: another lamp shifts all hues, but it does not change their order on the circle; of the M cyclic
orders the one is taken that fits clearly best.

No answer is a guess: votes that disagree, or two orders that fit alike, are a FitError.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import permutations

import numpy as np
import numpy.typing as npt

from common.arrays import Float, Int
from common.calibration import HandProfile, HsvRange
from common.errors import CalibrationError, FitError
from common.hand.model import HandModel
from slave.markers.autocolour import MarkerColour, Namer, Notify
from slave.markers.classify import HUES

Complex = npt.NDArray[np.complex128]

LEAST = 5  # fewer than five have no shape to go by
_OPEN = (
    "show the open hand, fingers spread, its back to the camera, for a second or more; or give clicks, or --like with "
    "a camera file whose colours are named"
)


def by_hand(profile: HandProfile, names: tuple[str, ...], notify: Notify = lambda _text: None) -> Namer:
    """Names from the picture of an open hand, its back to the camera.

    Raises:
        CalibrationError: The profile has no such marker.
        FitError: When called: too few or too many markers, or the frames do not determine the names.
    """
    if len(names) == 1:
        return lambda colours, uv: names
    pattern = pattern_of(profile, names)

    def name(colours: Sequence[MarkerColour], uv: Float) -> tuple[str, ...]:
        most = 7  # colours whose orders are tried: 5040 at most
        if not LEAST <= len(names) <= most:
            raise FitError(
                f"{len(names)} markers cannot be named from the shape of the hand, only {LEAST} to {most}: give "
                f"clicks, or --like with a camera file whose colours are named"
            )
        orders = np.array(list(permutations(range(len(names)))))
        votes, mirrored = votes_of(uv, pattern, orders)
        if mirrored > len(votes):
            raise FitError(
                f"in {mirrored} of {len(uv)} frames the hand is the mirror image of {profile.name!r} "
                f"({profile.side}): show the back of the hand, or choose the profile of the other side (rig.hand)"
            )
        votes_least = 5
        if len(votes) < votes_least:
            raise FitError(
                f"only {len(votes)} of {len(uv)} frames look like the open hand of {profile.name!r}: {_OPEN}"
            )
        best, count = Counter(votes).most_common(1)[0]
        share = count / len(votes)
        votes_share = 0.8  # of all votes
        if share < votes_share:
            raise FitError(
                f"the frames disagree about the names ({share:.0%} of {len(votes)} votes for the best order): {_OPEN}"
            )
        notify(f"names by the shape of the hand: {share:.0%} of {len(votes)} votes")
        return tuple(names[int(k)] for k in orders[best])

    return name


def pattern_of(profile: HandProfile, names: tuple[str, ...]) -> Float:
    """Return the markers (M, 2) of the flat hand as a camera sees its back.

    u to the right, v down, fingers up [m].

    Raises:
        CalibrationError: The profile has no such marker.
    """
    model = HandModel.of(profile)
    points = model.marker_points(model.forward(np.eye(4), np.zeros((5, 4))), names)
    # The palm frame has +z to the fingers and +y out of the back; whoever looks along -y has x to the left.
    return -points[:, [0, 2]]


def votes_of(uv: Float, pattern: Float, orders: Int) -> tuple[list[int], int]:
    """Count the votes of the frames that show all marker colours, or all but one.

    Args:
        uv: (F, M, 2) centroids [px]; NaN where not seen.
        pattern: (M, 2) the flat hand.
        orders: (P, M) row of the pattern of each marker colour.

    Returns:
        The order each voting frame is for, and how many frames see the mirrored hand better.
    """
    votes: list[int] = []
    mirrored = 0
    p = pattern[:, 0] + 1j * pattern[:, 1]
    for frame in uv[..., 0] + 1j * uv[..., 1]:
        seen = np.isfinite(frame)
        if seen.sum() < max(LEAST, len(p) - 1):
            continue
        z = _unit(frame[seen])
        ideal = _unit(p[orders[:, seen]])
        # |z - a p|^2 at the best a is 1 - |<p, z>|^2 for unit vectors.
        residual = np.sqrt(np.maximum(0.0, 1.0 - np.abs(ideal.conj() @ z) ** 2))
        reflected = np.sqrt(max(0.0, 1.0 - float(np.max(np.abs(ideal @ z))) ** 2))
        first, second = np.argpartition(residual, 1)[:2]
        most_residual = 0.25  # relative; a fist, or a hand from the side, has more
        clearer = 0.75  # of the runner-up's residual
        if reflected < clearer * residual[first] and reflected < most_residual:
            mirrored += 1
        elif residual[first] < most_residual and residual[first] < clearer * min(residual[second], reflected):
            votes.append(int(first))
    return votes, mirrored


def _unit(z: Complex) -> Complex:
    """Points (..., M) of the complex plane, centred, of unit norm."""
    z = z - z.mean(axis=-1, keepdims=True)
    return z / np.linalg.norm(z, axis=-1, keepdims=True)


def by_hues(
    markers: Mapping[str, HsvRange] | None,
    names: tuple[str, ...],
    where: str,
    notify: Notify = lambda _text: None,
) -> Namer:
    """Return a namer that uses the hues of a camera file.

    The file is of another camera or from before the lamp was changed.

    Raises:
        CalibrationError: The file has no range for a marker.
    """
    missing = [name for name in names if name not in (markers or {})]
    if missing or markers is None:
        raise CalibrationError(
            f"{where}: markers: no range for {', '.join(missing)}: no names can be taken from it"
        )
    middle = {name: _middle(markers[name]) for name in names}
    around = sorted(names, key=lambda name: middle[name])

    def name(colours: Sequence[MarkerColour], uv: Float) -> tuple[str, ...]:
        del uv
        order = sorted(range(len(colours)), key=lambda k: colours[k].hue)
        old = np.array([middle[name] for name in around])
        new = np.array([colours[k].hue for k in order])
        shifts = [(np.roll(old, s) - new + HUES / 2) % HUES - HUES / 2 for s in range(len(old))]
        residual = np.array([float(np.square(shift).sum()) for shift in shifts])
        best = int(np.argmin(residual))
        worst = float(np.abs(shifts[best]).max())
        hue_clearer = 0.25  # of the runner-up's sum of squares
        if len(old) > 1 and residual[best] > hue_clearer * float(np.sort(residual)[1]):
            raise FitError(
                f"{where}: its hues fit in two orders alike: the light is too different; give clicks, or leave the "
                f"names to the shape of the hand"
            )
        notify(f"names by the hues of {where}: the farthest is {worst:.0f} away")
        named = dict(zip(order, np.roll(np.array(around), best).tolist(), strict=True))
        return tuple(str(named[k]) for k in range(len(colours)))

    return name


def checked(namer: Namer, shape: Namer, notify: Notify = lambda _text: None) -> Namer:
    """Names of `namer`, refused where the shape of the hand is certain of others.

    Raises:
        FitError: When called: they disagree.
    """

    def name(colours: Sequence[MarkerColour], uv: Float) -> tuple[str, ...]:
        named = namer(colours, uv)
        try:
            shaped = shape(colours, uv)
        except FitError as error:
            notify(f"names not checked by the shape of the hand: {error}")
            return named
        if named != shaped:
            wrong = ", ".join(
                f"hue {p.hue:.0f}: {a} or {b}"
                for p, a, b in zip(colours, named, shaped, strict=True)
                if a != b
            )
            raise FitError(
                f"the names contradict the shape of the hand ({wrong}): another paint, clothing, or another hand? "
                f"Give clicks, or the right --like or --hand"
            )
        return named

    return name


def by_clicks(clicks: Mapping[str, tuple[float, float]], names: tuple[str, ...], width: int) -> Namer:
    """Names from one click on each marker in the first frame.

    Args:
        clicks: Marker -> (u, v) [px].
        names: Markers of the rig.
        width: Of the image [px].
    """

    def name(colours: Sequence[MarkerColour], uv: Float) -> tuple[str, ...]:
        del uv
        of: dict[int, str] = {}
        for marker in names:
            away: list[float] = []
            for colour in colours:
                first = [thing.pixels for thing in colour.things if thing.frame == 0]
                v, u = np.divmod(first[0], width) if first else (np.array([np.inf]), np.array([np.inf]))
                away.append(float(np.hypot(u - clicks[marker][0], v - clicks[marker][1]).min()))
            best = int(np.argmin(away))
            click_reach = 6.0  # px between a click and the nearest pixel of its marker colour
            if away[best] > click_reach:
                raise FitError(f"clicks.{marker}: no moving paint at {clicks[marker]} in the first frame")
            if best in of:
                raise FitError(f"clicks.{marker}: on the same paint as clicks.{of[best]}")
            of[best] = marker
        return tuple(of[k] for k in range(len(colours)))

    return name


def _middle(colour: HsvRange) -> float:
    low, high = colour.hsv_low[0], colour.hsv_high[0]
    return (low + ((high - low) % HUES) / 2.0) % HUES
