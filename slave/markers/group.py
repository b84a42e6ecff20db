"""Select the blobs that are markers, and count what else has their colour.

Used when the past does not answer: at the start, when a marker comes back, or when something in a marker's colour
competes with it. Markers of one hand are close together for their size, skin touches them, and tracked ones have a
place. Two blobs are linked when their distance is at most `REACH` times the geometric mean of their sizes, more where
skin touches both; the linked set with the best sum of evidence is the hand. On rendered hands neighbouring tips are
2-4 sizes apart, the little finger and the thumb 12, back and middle finger 7, clutter 10 and more.

What is counted beside the hand, so that somebody removes it, has at least `LEAST` px^2 and a share of the marker's
own area, does not touch the marker, and is no rim between two other colours.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import NamedTuple

import numpy as np

from slave.markers.classify import SCALE, Blob

REACH = 8.5  # marker sizes between neighbours of one hand
SKIN_REACH = 0.8  # how much farther, relatively, skin around both lets them be
SPECK = 24.0  # px^2; smaller blobs are rarely markers
CLICKED = 10.0  # bonus of the blob that the user clicked: it outweighs every alternative of its marker
TRACKED = 1.0  # bonus of the blob where the marker is expected: as much as being there
SECOND_HAND = 3  # markers of a group beside the first from which it is a hand
SKINLESS = 0.06  # caps on rendered hands have 0.12 and more


class Candidate(NamedTuple):
    """Blob that may be marker `marker`, with the evidence for it (`candidate`)."""

    marker: int
    blob: Blob
    skin: float  # share of its surroundings that is skin, 0..1
    fringe: bool  # it touches a much larger blob of another colour: perhaps only its rim
    bonus: float  # what click or track add to its score
    size: float  # side of a square of the same area [px]
    score: float  # sum of evidence; 1 for being there at all


def candidate(marker: int, blob: Blob, skin: float, fringe: bool, bonus: float) -> Candidate:
    """A candidate with its size and its score."""
    there = min(1.0, blob.area / SPECK) ** 2 * (0.3 if fringe else 1.0)
    score = there * (1.0 + min(1.0, 3.0 * skin)) + bonus
    return Candidate(marker, blob, skin, fringe, bonus, math.sqrt(blob.area), score)


def on_fringe(blob: Blob, others: Iterable[Blob]) -> bool:
    """Return whether `blob` may be the rim of a blob of another colour.

    At a rim the hue runs through other colours. It touches one that is much larger, or its middle lies in or next to
    the box of one that is as large: motion blur makes rims wide.
    """
    same = 0.7  # areas: a blob in the box of another colour's that is as large may be the rim of it
    fringe_ratio = 4.0  # areas: a blob so much smaller than its neighbour of another colour may be its fringe
    return any(
        blob.meets(other)  # boxes are as wide as the grid leaves open, so neighbours overlap
        for other in others
        if other.area > fringe_ratio * blob.area
        or (other.area > same * blob.area and other.holds(blob.u, blob.v, SCALE))
    )


def connected(blobs: Sequence[Blob]) -> bool:
    """Whether every blob is linked to another one; skin around both is presumed."""
    reach = (REACH * (1.0 + SKIN_REACH)) ** 2
    places = [(blob.u, blob.v, math.sqrt(blob.area)) for blob in blobs]
    for i, (u, v, size) in enumerate(places):
        for j, (other_u, other_v, other_size) in enumerate(places):
            if (u - other_u) ** 2 + (v - other_v) ** 2 <= reach * size * other_size and i != j:
                break
        else:
            return len(places) < 2
    return True


def choose(candidates: Sequence[Candidate], *, second: bool = True) -> dict[int, Candidate]:
    """Choose the markers among the candidates: marker row -> candidate.

    A marker without a plausible blob is absent. The best group is a hand; markers that it lacks may be on a second
    hand, a group of at least `SECOND_HAND` markers with skin, unless `second` is False. Less than that is clutter that
    happens to lie together.
    """
    links = _links(candidates)
    rest = set(range(len(candidates)))
    while True:
        best = _best_group(candidates, links, rest)
        members = [candidates[i] for i in best]
        strange = {
            i for i, c in zip(best, members, strict=True) if _strange(c, [o for o in members if o is not c])
        }
        if not strange:
            break
        rest -= strange  # what it kept out may be the marker
    found = {c.marker: c for c in members}
    # A fringe on the first hand must not keep a marker from the second.
    free = {
        i
        for i in rest
        if (taken := found.get(candidates[i].marker)) is None or (taken.fringe and not candidates[i].fringe)
    }
    if not second:
        return found
    more = [candidates[i] for i in _best_group(candidates, links, free)]
    more = [c for c in more if c.blob.area >= SPECK or c.bonus >= TRACKED]
    solid = [c for c in more if c.skin >= 2.0 * SKINLESS or c.bonus >= TRACKED]
    if len(solid) >= SECOND_HAND:
        markers = {c.marker for c in solid}
        found |= {c.marker: c for c in more if c.marker in markers or not _strange(c, solid)}
    return found


def choose_all(candidates: Sequence[Candidate], slots: Mapping[int, int]) -> list[Candidate]:
    """Choose the markers of all hands; `slots`: how many markers a row stands for.

    Markers on a further hand, painted alike, are those of a group that is one by itself, or tracked.
    """
    hands = max(slots.values(), default=1)
    if hands == 1:
        return list(choose(candidates).values())
    found: list[Candidate] = []
    for _ in range(2 * hands):  # a hand may fall in two groups
        taken = [c.marker for c in found]
        rest = [c for c in candidates if c not in found and taken.count(c.marker) < slots.get(c.marker, 1)]
        group = list(choose(rest, second=False).values())
        solid = [
            c for c in group if c.blob.area >= SPECK and (c.skin >= 2.0 * SKINLESS or c.bonus >= TRACKED)
        ]
        # the second is there: what is left of either may lie with the other's
        there = not found or len(solid) >= SECOND_HAND or len(taken) - len(set(taken)) >= SECOND_HAND
        found += [c for c in group if c.bonus >= TRACKED or (there and (not found or c.blob.area >= SPECK))]
    return found


def _links(candidates: Sequence[Candidate]) -> list[set[int]]:
    """Of each candidate those near enough to sit on one hand with it."""
    if not candidates:
        return []
    u, v, size, skin = np.array([(c.blob.u, c.blob.v, c.size, c.skin) for c in candidates]).T
    reach = REACH * (1.0 + SKIN_REACH * np.minimum(1.0, 4.0 * np.minimum(skin, skin[:, None])))
    near = (u - u[:, None]) ** 2 + (v - v[:, None]) ** 2 <= reach**2 * (size * size[:, None])
    return [set(row.nonzero()[0].tolist()) for row in near]


def _best_group(candidates: Sequence[Candidate], links: Sequence[set[int]], among: set[int]) -> list[int]:
    """The linked set with the best sum of evidence, one candidate of each marker."""
    best: list[int] = []
    best_score = -1.0
    for group in _components(links, among):
        alternatives: dict[int, list[int]] = {}
        for i in group:
            alternatives.setdefault(candidates[i].marker, []).append(i)
        members = [candidates[i] for i in group]
        chosen = [
            some[0] if len(some) == 1 else max(some, key=lambda i: _fit(candidates[i], members))
            for some in alternatives.values()
        ]
        score = sum(candidates[i].score for i in chosen)
        if score > best_score:
            best, best_score = chosen, score
    return best


def _components(links: Sequence[set[int]], among: set[int]) -> list[list[int]]:
    """Return the connected components of the candidates in a fixed order."""
    rest = set(among)
    groups: list[list[int]] = []
    while rest:
        first = min(rest)
        group, edge = {first}, {first}
        while edge:
            edge = set[int]().union(*(links[i] for i in edge)) & rest - group
            group |= edge
        rest -= group
        groups.append(sorted(group))
    return groups


def _fit(candidate: Candidate, members: Sequence[Candidate]) -> float:
    """Score how well one of a marker's alternatives suits the rest of its group."""
    others = [c for c in members if c.marker != candidate.marker and c.blob.area >= SPECK]
    if not others:
        return candidate.score + 1e-4 * candidate.blob.area
    typical = median([c.size for c in others])
    u, v = median([c.blob.u for c in others]), median([c.blob.v for c in others])
    away = math.hypot(candidate.blob.u - u, candidate.blob.v - v) / (REACH * typical)
    return candidate.score - 0.5 * abs(math.log(candidate.size / typical)) - 0.3 * away


def _strange(candidate: Candidate, others: Sequence[Candidate]) -> bool:
    """Whether a blob lies like clutter beside a hand: no skin, and large or thin."""
    others = [c for c in others if c.blob.area >= SPECK]
    if not others or candidate.bonus >= TRACKED or candidate.skin >= SKINLESS:
        return False
    if median([c.skin for c in others]) < 3.0 * SKINLESS:
        return False
    blob = candidate.blob
    slack = SCALE - 1  # of the box, see `Blob`
    fill = blob.area / (max(blob.right - blob.left - slack, 1) * max(blob.bottom - blob.top - slack, 1))
    largest, typical = max(c.blob.area for c in others), median([c.blob.area for c in others])
    strange_size = 2.5  # typical areas of the group, and
    strange_share = 0.6  # of its largest: above the lesser of the two, a skinless blob is clutter
    strange_fill = 0.3  # of its box; less is thin like a pen
    return blob.area > min(strange_size * typical, strange_share * largest) or (
        blob.area >= SPECK and fill < strange_fill
    )


LEAST = 40.0  # px^2: specks come and go in every picture


class ColourAmbiguityMonitor:
    """Push machine that counts things in the colour of a marker beside it.

    `frames`: marker -> in how many; `places`: marker -> (u, v) [px] of the largest thing in the last such frame.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Count for these markers."""
        self._names = tuple(names)
        self.frames = dict.fromkeys(self._names, 0)
        self.places: dict[str, tuple[float, float]] = {}

    def push(self, blobs: Sequence[Sequence[Blob]], chosen: Mapping[int, Blob]) -> None:
        """Look at a frame: blobs of each colour, largest first; row -> the marker's blob."""
        if not chosen:
            return  # no hand to be beside of
        for m, options in enumerate(blobs):
            own = chosen.get(m)
            if len(options) <= (own is not None):
                continue
            share = 0.3  # of the marker's area
            least = LEAST if own is None else max(LEAST, share * own.area)
            rims = [blob for n, blob in chosen.items() if n != m]
            for blob in options:
                if blob.area < least:
                    break
                # nearer to the marker than it is large, it may be a piece of it
                if own is not None and blob.meets(own, 1 + max(own.right - own.left, own.bottom - own.top)):
                    continue
                if not on_fringe(blob, rims) and not any(blob.holds(rim.u, rim.v, SCALE) for rim in rims):
                    name = self._names[m]
                    self.frames[name] += 1
                    self.places[name] = blob.u, blob.v
                    break
