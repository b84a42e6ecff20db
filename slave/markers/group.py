"""Choose among all blobs those that are markers: the ones that belong together, as markers of one hand do.

Used when the past does not answer: at the start, when a marker comes back, or when something in the marker's
colour (a green mug, a blue pen) competes with it. Three facts tell markers from clutter, none of which knows the
hand: markers are close together for their size, skin touches them, and those of the past have a place.

Two blobs are linked when their distance is at most `REACH` times the geometric mean of their sizes, more where skin
touches both; the linked set with the best sum of evidence is the hand. Measured on rendered hands: neighbouring
tips are 2-4 sizes apart, the little finger and the thumb 12, back and middle finger 7, clutter 10 and more.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Image
from slave.markers.blobs import Blob
from slave.markers.classify import ColourTable

REACH = 8.5  # marker sizes between neighbours of one hand
SKIN_REACH = 0.8  # how much farther, relatively, skin around both lets them be
RING = 2  # px around the box in which skin is sought
SPECK = 24.0  # px^2; smaller blobs are rarely markers
FRINGE = 0.3  # what a fringe counts
SAME = 0.7  # areas: a blob in the box of another colour's that is as large may be the rim of it
FRINGE_RATIO = 4.0  # areas: a blob so much smaller than its neighbour of another colour may be its fringe
CLICKED = 10.0  # bonus of the blob that the user clicked: it outweighs every rival of its marker
TRACKED = 1.0  # bonus of the blob where the marker is expected: as much as being there
SKINLESS = 0.06  # caps on rendered hands have 0.12 and more
STRANGE_SIZE = 2.5  # typical areas of the group, and
STRANGE_SHARE = 0.6  # of its largest: above the lesser of the two, a skinless blob is clutter
STRANGE_FILL = 0.3  # of its box; less is thin like a pen
SECOND_HAND = 3  # markers


@dataclass(frozen=True, slots=True)
class Candidate:
    """A blob that may be marker `marker`, and what speaks for it.

    Attributes:
        marker: Row of the marker.
        blob: The blob.
        skin: Share of its surroundings that is skin, 0..1.
        fringe: It touches a much larger blob of another colour: perhaps only the rim of that one.
        bonus: What click or track add to its score.
    """

    marker: int
    blob: Blob
    skin: float
    fringe: bool
    bonus: float

    @property
    def size(self) -> float:
        """Side of a square of the same area [px]."""
        return math.sqrt(self.blob.area)

    @property
    def score(self) -> float:
        """Sum of evidence; 1 for being there at all."""
        there = min(1.0, self.blob.area / SPECK) ** 2 * (FRINGE if self.fringe else 1.0)
        return there * (1.0 + min(1.0, 3.0 * self.skin)) + self.bonus


def skin_share(image: Image, table: ColourTable, blob: Blob) -> float:
    """Share of the pixels around the blob's box that have the hue and saturation of skin, 0..1."""
    top, left = max(blob.top - RING, 0), max(blob.left - RING, 0)
    window = image[top : blob.bottom + RING, left : blob.right + RING]
    skin = np.count_nonzero(table.codes(window) & table.skin)
    around = window.shape[0] * window.shape[1] - blob.area
    return min(1.0, skin / max(around, 1.0))


def on_fringe(blob: Blob, others: Iterable[Blob]) -> bool:
    """Whether `blob` may be the rim of a blob of another colour, where the hue runs through its own: it touches one
    that is much larger, or lies in the box of one that is as large (motion blur makes rims wide)."""
    return any(
        blob.left < other.right  # boxes are as wide as the grid leaves open, so neighbours overlap
        and other.left < blob.right
        and blob.top < other.bottom
        and other.top < blob.bottom
        for other in others
        if other.area > FRINGE_RATIO * blob.area
        or (
            other.area > SAME * blob.area
            and other.left <= blob.u <= other.right
            and other.top <= blob.v <= other.bottom
        )
    )


def linked(a: Candidate, b: Candidate) -> bool:
    """Whether two blobs are near enough to sit on one hand."""
    reach = REACH * (1.0 + SKIN_REACH * min(1.0, 4.0 * min(a.skin, b.skin)))
    return math.hypot(a.blob.u - b.blob.u, a.blob.v - b.blob.v) <= reach * math.sqrt(a.size * b.size)


def connected(blobs: Sequence[Blob]) -> bool:
    """Whether every blob is linked to another one; skin around both is taken as given, since the past vouches."""
    reach = (REACH * (1.0 + SKIN_REACH)) ** 2
    rest = list(blobs)
    if len(rest) < 2:
        return True
    for a in rest:
        limit = reach * math.sqrt(a.area)
        if not any(
            (a.u - b.u) ** 2 + (a.v - b.v) ** 2 <= limit * math.sqrt(b.area) for b in rest if b is not a
        ):
            return False
    return True


def choose(candidates: Sequence[Candidate]) -> dict[int, Candidate]:
    """The markers among the candidates: marker row -> candidate. A marker without a plausible blob is absent.

    The best group is a hand. Markers that it has not may be on a second hand: a group of at least `SECOND_HAND`
    markers with skin. Less than that is clutter that happens to lie together.
    """
    rest = list(candidates)
    while True:
        best = _best_group(rest)
        strange = [c for c in best.values() if _strange(c, [o for o in best.values() if o is not c])]
        if not strange:
            break
        rest = [c for c in rest if c not in strange]  # what it kept out may be the marker
    # A fringe on the first hand must not keep a marker from the second.
    free = [c for c in rest if c.marker not in best or (best[c.marker].fringe and not c.fringe)]
    second = _best_group(free)
    members = [c for c in second.values() if c.blob.area >= SPECK or c.bonus >= TRACKED]
    solid = [c for c in members if c.skin >= 2.0 * SKINLESS or c.bonus >= TRACKED]
    if len(solid) < SECOND_HAND:
        return best
    return best | {c.marker: c for c in members if c in solid or not _strange(c, solid)}


def _best_group(candidates: Sequence[Candidate]) -> dict[int, Candidate]:
    best: dict[int, Candidate] = {}
    best_score = -1.0
    for members in _components(candidates):
        chosen: dict[int, Candidate] = {}
        for candidate in members:
            rival = chosen.get(candidate.marker)
            if rival is None or _fit(candidate, members) > _fit(rival, members):
                chosen[candidate.marker] = candidate
        score = sum(c.score for c in chosen.values())
        if score > best_score:
            best, best_score = chosen, score
    return best


def _components(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Groups of candidates that are linked directly or through others, in a fixed order."""
    rest = list(candidates)
    groups: list[list[Candidate]] = []
    while rest:
        group = [rest.pop(0)]
        for member in group:  # grows while it is walked
            near = [c for c in rest if linked(member, c)]
            group.extend(near)
            rest = [c for c in rest if c not in near]
        groups.append(group)
    return groups


def _fit(candidate: Candidate, members: Sequence[Candidate]) -> float:
    """How well a candidate suits the rest of its group, to choose among rivals of one marker."""
    others = [c for c in members if c.marker != candidate.marker and c.blob.area >= SPECK]
    if not others:
        return candidate.score + 1e-4 * candidate.blob.area
    typical = _median([c.size for c in others])
    u, v = _median([c.blob.u for c in others]), _median([c.blob.v for c in others])
    away = math.hypot(candidate.blob.u - u, candidate.blob.v - v) / (REACH * typical)
    return candidate.score - 0.5 * abs(math.log(candidate.size / typical)) - 0.3 * away


def _strange(candidate: Candidate, others: Sequence[Candidate]) -> bool:
    """Whether a blob lies like clutter beside a hand: no skin touches it, and it is as large as the largest
    marker, or thin like a pen. A cap seen from its tip has no skin around it either, but it is small and round.
    """
    others = [c for c in others if c.blob.area >= SPECK]
    if not others or candidate.bonus >= TRACKED or candidate.skin >= SKINLESS:
        return False
    if _median([c.skin for c in others]) < 3.0 * SKINLESS:
        return False
    blob = candidate.blob
    fill = blob.area / ((blob.right - blob.left) * (blob.bottom - blob.top))
    largest, typical = max(c.blob.area for c in others), _median([c.blob.area for c in others])
    return blob.area > min(STRANGE_SIZE * typical, STRANGE_SHARE * largest) or (
        blob.area >= SPECK and fill < STRANGE_FILL
    )


def _median(values: Sequence[float]) -> float:
    """Median of a few numbers; numpy's takes 50 times as long for six."""
    ordered = sorted(values)
    return 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
