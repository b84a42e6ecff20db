"""Prior of a hand before a marker is seen.

It covers the posture priors of natural and of free hands, and curled fingers.

Every prior is a row of a least-squares problem that is linear in the free angles, divided by its standard deviation.

Hands mostly follow joint couplings, and now and then defy them altogether: a gun, horns, a pianist. One width would
be too wide for the former or too narrow for the latter. So there are two hypotheses of every hand, *natural* and
*free*, and the evidence of the markers decides how much each counts (MacKay 1992, "Bayesian interpolation": the
width of the prior is what a free hand gains in fit and pays in volume).
"""

from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand.model import HandModel
from master.estimator.parameters import HandParameters
from master.estimator.settings import DEFAULT, Settings

Row = tuple[dict[int, float], float, float]


class PosturePrior(NamedTuple):
    """Prior on the free angles x of H hypotheses.

    The cost is x normal x / 2 - pull x + constant, half a sum of squares.

    Attributes:
        normal: (H, n, n).
        pull: (H, n).
        constant: (H,) so that the cost is that of the squares.
        log_density: (H,) logarithm of the density at cost 0, but for what the hypotheses have in common.
    """

    normal: Float
    pull: Float
    constant: Float
    log_density: Float

    def without(self, columns: Int, mean: float, sigma: float) -> "PosturePrior":
        """Return the prior without single-angle rows in the first hypothesis.

        The rows removed are those on each of these angles by itself.
        """
        normal, pull, constant = self.normal.copy(), self.pull.copy(), self.constant.copy()
        normal[0, columns, columns] -= 1.0 / sigma**2
        pull[0, columns] -= mean / sigma**2
        constant[0] -= 0.5 * len(columns) * (mean / sigma) ** 2
        return PosturePrior(normal, pull, constant, self.log_density)

    def natural_component(self) -> "PosturePrior":
        """Those of the first hypothesis alone."""
        return PosturePrior(self.normal[:1], self.pull[:1], self.constant[:1], self.log_density[:1])


def posture_prior_of(
    model: HandModel,
    parameters: HandParameters,
    settings: Settings = DEFAULT,
    unlike: frozenset[int] = frozenset(),
) -> PosturePrior:
    """Return the posture priors of a natural hand and of a free one.

    Args:
        model, parameters: The hand.
        settings: Widths and means.
        unlike: Fingers of which it is known that they are not bent as the others: those are no neighbours.
    """
    tables = [
        _table(parameters, _natural_rows(model, settings, unlike)),
        _table(parameters, _free_rows(model, settings)),
    ]
    normal = np.array([rows.T @ rows for rows, _ in tables])
    pull = np.array([means @ rows for rows, means in tables])
    constant = np.array([0.5 * float(means @ means) for _, means in tables])
    least = constant - 0.5 * np.vecdot(pull, np.linalg.solve(normal, pull[..., None])[..., 0])
    volume = normal.copy()
    if model.posture is None:
        flexion = np.flatnonzero((parameters.free >= 4) & (parameters.free % 4 == 1))
        narrowest_rad = 1e-3  # limits that leave an angle no room
        span = np.maximum(parameters.legal_high - parameters.legal_low, narrowest_rad)[flexion]
        # The highest density of a normal distribution of this width is that of any angle within the span.
        volume[1, flexion, flexion] += 2.0 * np.pi / span**2
    share = np.log([settings.natural_prior_weight, 1.0 - settings.natural_prior_weight])
    return PosturePrior(normal, pull, constant, share + least + 0.5 * np.linalg.slogdet(volume)[1])


def curled(parameters: HandParameters, settings: Settings, fingers: Bool) -> tuple[Float, Float]:
    """Return the inverse variances and means (n,) of curled fingers' angles.

    The fingers (5,) are curled out of sight.
    """
    angles, sigma = np.zeros((5, 4)), np.full((5, 4), np.inf)
    s = settings
    angles[0] = (
        s.curled_thumb_abduction_rad,
        s.curled_thumb_flexion_rad,
        s.curled_thumb_mcp_rad,
        s.curled_thumb_ip_rad,
    )
    sigma[0] = settings.curled_rad
    angles[1:, 1:3] = settings.curled_flexion_rad, settings.curled_pip_rad
    sigma[1:, 1:3] = settings.curled_rad
    sigma[~fingers] = np.inf
    return parameters.free_of(sigma) ** -2.0, parameters.of_angles(angles)


def _natural_rows(model: HandModel, s: Settings, unlike: frozenset[int]) -> list[Row]:
    """Return the prior rows of a natural hand.

    They are natural flexion, small abduction, neighbours alike, a loose thumb; angles by their place in the flat
    table.
    """
    if model.posture is not None:
        return _posture_rows(*model.posture, 1.0)
    thumb = (
        s.thumb_abduction_mean_rad,
        s.thumb_flexion_mean_rad,
        s.thumb_mcp_mean_rad,
        s.thumb_ip_mean_rad,
    )
    rows: list[Row] = [({k: 1.0}, mean, s.thumb_rad) for k, mean in enumerate(thumb)]
    rows.append(({2: -1.0, 3: 1.0}, 0.0, s.thumb_rad))
    for f in range(1, 5):
        a = 4 * f
        rows.append(({a: 1.0}, 0.0, s.abduction_rad))
        if model.mcp_per_pip is None:
            rows.append(({a + 1: 1.0}, s.pip_mean_rad, s.pip_rad))  # as little as is known of the PIP
        else:
            rows.append(({a + 1: 1.0, a + 2: -model.mcp_per_pip}, 0.0, s.natural_flexion_rad))
        rows.append(({a + 2: 1.0}, s.pip_mean_rad, s.pip_rad))
        rows += _loose_dip(model, a, s)
        if model.neighbours and f < 4 and (f in unlike) == (f + 1 in unlike):
            rows.append(({a + 1: 1.0, a + 5: -1.0}, 0.0, s.neighbour_flexion_rad))
            rows.append(({a + 2: 1.0, a + 6: -1.0}, 0.0, s.neighbour_pip_rad))
    return rows


def _posture_rows(mean: Float, cov: Float, wider: float) -> list[Row]:
    """How this person holds the fingers, where that was measured: whitened rows."""
    rows: list[Row] = []
    factor = np.linalg.cholesky(np.linalg.inv(cov)).astype(np.float64)
    for k in range(20):
        row = factor[:, k]
        rows.append(({a: float(row[a]) for a in range(20)}, float(row @ mean), wider))
    return rows


def _free_rows(model: HandModel, s: Settings) -> list[Row]:
    """Joints that know nothing of each other: as if drawn evenly from their limits."""
    if model.posture is not None:
        return _posture_rows(*model.posture, s.posture_widened)
    low, high = model.limits_rad[..., 0], model.limits_rad[..., 1]
    middle, span = (0.5 * (low + high)).tolist(), high - low
    even = (span / np.sqrt(12.0)).tolist()  # standard deviation of an even distribution
    rows: list[Row] = [({k: 1.0}, middle[0][k], even[0][k] or s.thumb_rad) for k in range(4)]
    for f in range(1, 5):
        a = 4 * f
        rows.append(({a: 1.0}, middle[f][0], even[f][0] or s.abduction_rad))
        rows.append(({a + 1: 1.0}, middle[f][1], 2.0 * float(span[f, 1]) or s.pip_rad))  # next to nothing
        rows.append(({a + 2: 1.0}, s.free_pip_mean_rad, s.free_pip_rad))
        rows += _loose_dip(model, a, s)
    return rows


def _loose_dip(model: HandModel, a: int, s: Settings) -> list[Row]:
    """Return the row that couples a DIP to its PIP.

    The finger's angles begin at `a`. There is a row only if the DIP follows loosely.
    """
    if model.dip_per_pip is None:
        return [({a + 3: 1.0, a + 2: -s.loose_dip_per_pip}, 0.0, s.loose_dip_rad)]
    if model.dip_spread_rad > 0.0:
        return [({a + 3: 1.0, a + 2: -model.dip_per_pip}, 0.0, model.dip_spread_rad)]
    return []


def _table(parameters: HandParameters, rows: list[Row]) -> tuple[Float, Float]:
    """Rows (P, n) and means (P,), divided by their standard deviations."""
    column = {int(angle): c for c, angle in enumerate(parameters.free)}
    table, means = np.zeros((len(rows), len(column))), np.zeros(len(rows))
    for r, (terms, mean, sigma) in enumerate(rows):
        for angle, factor in terms.items():
            table[r, column[angle]] = factor / sigma
        means[r] = mean / sigma
    return table, means
