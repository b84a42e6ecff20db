"""Where in the image each finger runs: its spine, the middle of the lit finger at every row.

A finger is nearly straight in the image, from a knuckle that is known to wherever it leans. So of a fan of lines
through the knuckle the one is taken along which the image looks most like a finger (`slave.wrist.tip_templates`, few
of them), and from it each row is drawn to the middle of what is lit around.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from common.arrays import Float, Int
from slave.wrist.led_depth import SHRINK, Float32
from slave.wrist.tip_templates import FingerTemplates, templates_of
from slave.wrist.view import WristView

LEANS_RAD = np.radians(np.arange(-24.0, 24.1, 3.0))  # fingers spread by up to 20 degrees, and look more so from aside
LEAN_SIGMA_RAD = np.radians(10.0)
SPREAD_SHARE = 0.3  # of the nearness of the brightest beside it: what is darker is a gap
REACH = 5  # shrunken pixels aside: half a finger
ROUNDS = 2
LIKENESS = 5e-4  # of 1 - cosine between profile and template: what flesh differs from capsules
GAIN_SIGMA = 0.15  # of the logarithm of what a finger returns beside the palm: skin, creases, stray light


@dataclass(frozen=True, slots=True, eq=False)
class Fan:
    """The lines through one knuckle.

    Attributes:
        u: (L, rows) columns of the shrunken image.
        pixel: (L, rows) the same as places in the flattened image.
        coarse: Every how many of the finger's templates are compared, as indices.
        unit, length: Those templates.
        prior: (L,) log probability of each lean.
    """

    u: Float
    pixel: Int
    unit: Float32
    log_length: Float32
    prior: Float


@lru_cache(maxsize=8)
def fans_of(view: WristView) -> tuple[Fan, ...]:
    """The fans of index ... little of one wrist rig and hand; made once."""
    width = view.optics.width_px // SHRINK
    return tuple(_fan(templates, width) for templates in templates_of(view))


def _fan(templates: FingerTemplates, width: int) -> Fan:
    v = np.arange(templates.rows)
    root = (templates.root_uv - 0.5 * (SHRINK - 1)) / SHRINK
    u = np.clip(root[0] + np.tan(LEANS_RAD)[:, None] * (root[1] - v), 0.0, width - 1.0)
    few = np.flatnonzero((np.arange(len(templates.unit)) % 6) == 1)
    return Fan(
        u=u,
        pixel=v * width + np.rint(u).astype(np.int64),
        unit=templates.unit[few],
        log_length=np.log(templates.length[few]),
        prior=-0.5 * (LEANS_RAD / LEAN_SIGMA_RAD) ** 2,
    )


def spine(near: Float32, fan: Fan, gain: float) -> Float:
    """Columns (rows,) of one finger's middle in the shrunken image.

    Args:
        near: (h, w) nearness.
        fan: The finger's.
        gain: Logarithm of nearness [grey levels^0.5] by nearness [1/m].
    """
    seen = near.ravel()[fan.pixel]
    size = np.sqrt((seen * seen).sum(axis=1)) + np.float32(1e-6)
    like = fan.unit @ seen.T
    away = np.log(np.maximum(like, 1e-6)) - fan.log_length[:, None] - gain
    score = (like / size - 1.0) / LIKENESS - 0.5 * (away / GAIN_SIGMA) ** 2
    line = fan.u[int(np.argmax(score.max(axis=0) + fan.prior))]
    rows = np.arange(len(line))[:, None]
    aside = np.arange(-REACH, REACH + 1)
    for _ in range(ROUNDS):
        columns = np.clip(np.rint(line).astype(np.int64)[:, None] + aside, 0, near.shape[1] - 1)
        light = near[rows, columns]
        light = np.where(light > SPREAD_SHARE * light.max(axis=1, keepdims=True), light * light, 0.0)
        mass = light.sum(axis=1)
        line = np.where(mass > 0.0, (light * columns).sum(axis=1) / np.maximum(mass, 1e-6), line)
    return line
