"""The floor under every centroid: what the noise of the sensor leaves to know, if all but the place were known.

Cramér-Rao for independent Gaussian noise: the Fisher information of the place is J = sum (dL/dp)^T (dL/dp) / var
over the pixels, L the noiseless light and p = (u, v); no unbiased estimate has a smaller covariance than J^-1. The
derivative comes from the frames' own generator by central differences, so blur, shading and background are in it.
"""

from typing import Final, cast

import numpy as np

from bench.marker_frames import generator, variance
from bench.marker_kinds import Kind
from bench.marker_scene import make_scene
from common.arrays import Float

HALF_STEP: Final = 0.125  # px: sub-pixels are 1/8 px


def floor_px(kind: Kind, count: int, seed: int = 1) -> Float:
    """Smallest standard deviation per axis [px] of every marker of the first frames of `count` sequences, (N,)."""
    floors: list[float] = []
    for k in range(count):
        scene = make_scene(kind, generator(kind, k, seed))
        inverse = 1.0 / variance(scene.light(scene.caps), kind.noise)
        sensitivities = [
            (
                scene.light(tuple(c.moved(du, dv) for c in scene.caps))
                - scene.light(tuple(c.moved(-du, -dv) for c in scene.caps))
            )
            / (2.0 * HALF_STEP)
            for du, dv in ((HALF_STEP, 0.0), (0.0, HALF_STEP))
        ]
        for cap in scene.caps:
            reach = max(cap.a, cap.b) + 3.0 + 0.5 * kind.blur_px
            window = np.s_[
                max(round(cap.v - reach), 0) : round(cap.v + reach) + 1,
                max(round(cap.u - reach), 0) : round(cap.u + reach) + 1,
            ]
            su, sv, weight = sensitivities[0][window], sensitivities[1][window], inverse[window]
            uu, uv, vv = ((a * b * weight).sum() for a, b in ((su, su), (su, sv), (sv, sv)))
            covariance = cast(Float, np.linalg.inv(np.array([[uu, uv], [uv, vv]], np.float64)))
            floors.append(float(np.sqrt(np.trace(covariance) / 2.0)))
    return np.array(floors)
