"""Relative poses of the cameras, from views that two of them share.

Wrong views are outvoted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.errors import FitError
from common.geometry.transforms import fit_rigid, invert, transform
from master.calibrate.cameras.boards import Board, board_corners, orderings

Places = Mapping[str, Mapping[str, Float]]
"""Camera -> view -> T_camera_board (4, 4) [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """First estimate of a rig.

    Attributes:
        T_camera_rig: Camera -> (4, 4) [m]; the rig's frame is that of the first camera.
        corner_order: View -> camera -> order (N,): what the camera calls corner i is corner order[i] of the view.
    """

    T_camera_rig: Mapping[str, Float]
    corner_order: Mapping[str, Mapping[str, Int]]


def link(board: Board, cameras: Sequence[str], places: Places) -> Links:
    """Chain the cameras by the pairs that share most views.

    Raises:
        FitError: The cameras fall into groups that share no view; the text names them.
    """
    drawn = board_corners(board)
    # Corner i of a turned board is corner order[i] of the upright one.
    turns = [(order, fit_rigid(drawn, drawn[order])) for order in orderings(board)]
    known: dict[str, Float] = {cameras[0]: np.eye(4)}
    while len(known) < len(cameras):
        shared = {
            (a, b): sorted(places[a].keys() & places[b].keys())
            for a in known
            for b in cameras
            if b not in known
        }
        a, b = max(shared, key=lambda pair: len(shared[pair]))
        if not shared[a, b]:
            raise FitError(_islands(cameras, places))
        known[b] = _relative(drawn, turns, places[b], places[a], shared[a, b]) @ known[a]
    return Links(known, _corner_orders(drawn, turns, known, places))


def _relative(
    drawn: Float,
    turns: list[tuple[Int, Float]],
    to: Mapping[str, Float],
    of: Mapping[str, Float],
    views: list[str],
) -> Float:
    """Return the view estimate of T_to_of with the least median distance.

    Shape (4, 4) [m]: of all views' estimates, the one with the least median distance from the others.
    """
    candidates = [
        np.stack([to[view] @ rotation @ invert(of[view]) for _, rotation in turns]) for view in views
    ]
    points = [transform(of[view], drawn) for view in views]

    def distance(T: Float) -> float:
        """Return the median distance of the board from where T puts it.

        Median over views in [m], in the ordering that suits.
        """
        off = [
            min(float(np.linalg.norm(transform(T, p) - transform(other, p), axis=1).mean()) for other in own)
            for own, p in zip(candidates, points, strict=True)
        ]
        return float(np.median(off))

    return min((T for own in candidates for T in own), key=distance)


def _corner_orders(
    drawn: Float, turns: list[tuple[Int, Float]], known: Mapping[str, Float], places: Places
) -> dict[str, dict[str, Int]]:
    """Return the order of each camera's corners for each view.

    The order that agrees best with the first camera of the view.
    """
    corner_order: dict[str, dict[str, Int]] = {}
    for view in sorted(set[str]().union(*places.values())):
        first: Float | None = None
        corner_order[view] = {}
        for camera in known:
            if view not in places[camera]:
                continue
            in_rig = [invert(known[camera]) @ places[camera][view] @ rotation for _, rotation in turns]
            best = 0
            if first is None:
                first = in_rig[0]
            else:
                there = transform(first, drawn)
                best = int(np.argmin([np.linalg.norm(transform(T, drawn) - there) for T in in_rig]))
            corner_order[view][camera] = turns[best][0]
    return corner_order


def _islands(cameras: Sequence[str], places: Places) -> str:
    groups: list[list[str]] = []
    for camera in cameras:
        touching = [g for g in groups if any(places[camera].keys() & places[other].keys() for other in g)]
        groups = [g for g in groups if g not in touching] + [
            [*(name for g in touching for name in g), camera]
        ]
    named = " and ".join("{" + ", ".join(group) + "}" for group in groups)
    return f"the cameras {named} share no view of the board: show it to both groups at once"
