"""An object is carried where it moves with the palm; not where it rests, is far, or is moved by somebody else."""

from collections.abc import Callable

import numpy as np
import pytest

from common.arrays import Float
from common.geometry.transforms import rigid, rotation_vector_to_matrix, transform
from master.objects.contact import Carried

STEP_NS = 16_666_667
PALM_M = np.array([0.01, 0.03, -0.02])  # object frame
NOISE_M = 0.002


def object_at(t_s: float) -> Float:
    """Rests for a second, is lifted by 10 cm, turned by 40 degrees about an axis beside it, and rests."""
    share = float(np.clip((t_s - 1.0) / 1.0, 0.0, 1.0))
    rotation = np.radians(40.0) * float(np.clip((t_s - 2.5) / 1.0, 0.0, 1.0))
    return rigid(
        rotation_vector_to_matrix(np.array([0.0, 0.0, rotation])), np.array([0.0, -0.1 * share, 0.5])
    )


def carried_rows(
    seconds: float,
    palm_at: Callable[[float], Float] | None = None,
    distance_m: float = 0.03,
    away_s: float = 1e9,
) -> list[bool]:
    """What is told of a palm that is fixed to the object, or where `palm_at` says (time -> rig frame)."""
    rng, carried, out = np.random.default_rng(3), Carried(), list[bool]()
    for k in range(int(seconds * 60)):
        t_s = k / 60
        T = object_at(t_s)
        palm = transform(T, PALM_M) if palm_at is None else palm_at(t_s)
        palm = palm + rng.normal(0.0, NOISE_M, 3)
        out.append(carried.push(k * STEP_NS, T, palm, distance_m, t_s >= away_s))
    return out


def test_what_is_lifted_and_turned_is_carried_and_stays_so_at_rest() -> None:
    output = carried_rows(5.0)
    assert not any(output[:60])  # at rest beside a hand at rest: nobody knows
    assert all(output[60 + 30 :])  # half a second after it begins to move


def test_a_hand_that_rests_next_to_what_others_move_carries_nothing() -> None:
    assert not any(carried_rows(5.0, lambda t_s: transform(object_at(0.0), PALM_M)))


def test_a_hand_that_passes_an_object_at_rest_carries_nothing() -> None:
    assert not any(
        carried_rows(1.0, lambda t_s: transform(object_at(0.0), PALM_M) + np.array([0.2 * t_s, 0.0, 0.0]))
    )


def test_what_moves_alike_but_far_away_is_not_carried() -> None:
    assert not any(carried_rows(5.0, distance_m=0.08))


def test_fingers_that_are_seen_to_be_away_let_go() -> None:
    output = carried_rows(5.0, away_s=4.0)
    assert output[239]
    assert not any(output[240:])


def test_a_palm_that_moves_on_has_left_it() -> None:
    """At rest again it stays carried, until the palm is 3 cm elsewhere on it: here after 0.3 s."""

    def palm(t_s: float) -> Float:
        return transform(object_at(t_s), PALM_M) + np.array([0.0, 0.0, -0.1 * max(t_s - 4.0, 0.0)])

    output = carried_rows(5.0, palm)
    assert output[240]
    assert not any(output[240 + 24 :])


@pytest.mark.parametrize("lost", [np.full(3, np.nan)])
def test_a_palm_that_is_not_known_for_a_moment_changes_nothing(lost: Float) -> None:
    carried = Carried()
    for k in range(120):
        T = object_at(k / 60)
        carried.push(k * STEP_NS, T, transform(T, PALM_M), 0.03, False)
    T = object_at(2.0)
    assert carried.push(120 * STEP_NS, T, lost, float("nan"), False)
    assert carried.push(121 * STEP_NS, T, transform(T, PALM_M), 0.03, False)
    carried.forget()
    assert not carried.push(122 * STEP_NS, T, transform(T, PALM_M), 0.03, False)
