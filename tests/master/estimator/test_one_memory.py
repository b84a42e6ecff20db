"""`HandState` is the estimator's only memory: a copy of it gives the same hand, whatever was solved before."""

from copy import deepcopy
from dataclasses import dataclass, fields
from typing import Any, cast

import numpy as np
import pytest

from bench.both.scene import shown, solve
from common.records import boxed
from master.estimator.epoch import Epoch, Fitted
from master.estimator.estimator import Estimator


@dataclass(frozen=True, slots=True)
class Push:
    """What went into the estimator at an epoch, and what came out."""

    epoch: Epoch
    before: bytes  # the state
    after: bytes
    fitted: Fitted


@pytest.fixture(scope="module")
def pushes() -> tuple[Estimator, list[Push]]:
    """An estimator of markers, wrist device and IMU, and all that it was given in a second."""
    found, used = list[Push](), list[Estimator]()
    push = Estimator.push

    def kept(self: Estimator, at: Epoch) -> Fitted:
        epoch, before = deepcopy(at), boxed(self.state).tobytes()
        fitted = push(self, at)
        if self.wrist:
            used.append(self)
            found.append(Push(epoch, before, boxed(self.state).tobytes(), deepcopy(fitted)))
        return fitted

    both = shown("both-curl", 1.0, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Estimator, "push", kept)
        solve(both.both.fused, both.messages)
    assert len(found) >= 50
    return used[-1], found


def same(one: object, other: object) -> bool:
    if isinstance(one, np.ndarray):
        return one.tobytes() == cast(Any, other).tobytes()
    if hasattr(one, "__dataclass_fields__"):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(cast(Any, one)))
    return repr(one) == repr(other)


def test_epochs_in_any_order_give_the_same_hands_from_copies_of_the_state(
    pushes: tuple[Estimator, list[Push]],
) -> None:
    estimator, found = pushes
    for k in np.random.default_rng(1).permutation(len(found)).tolist():
        boxed(estimator.state)[...] = np.frombuffer(found[k].before, boxed(estimator.state).dtype)
        fitted = estimator.push(found[k].epoch)
        assert boxed(estimator.state).tobytes() == found[k].after, f"epoch {k}: another state"
        assert same(fitted, found[k].fitted), f"epoch {k}: another hand"


def test_a_state_that_was_not_copied_is_seen(pushes: tuple[Estimator, list[Push]]) -> None:
    estimator, found = pushes
    estimator.push(found[-1].epoch)
    estimator.push(found[len(found) // 2].epoch)
    assert boxed(estimator.state).tobytes() != found[len(found) // 2].after
