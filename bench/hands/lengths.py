"""Lengths of fingers by the routine of `calibrate hand`, of simulated users, against exact truth.

Every user has another hand, motion and noise. A finger is its length from knuckle to cap, the thumb from its CMC. A
length is measured when the markers determine it within 1 mm with 99 % certainty.
"""

from collections.abc import Iterator
from time import process_time

import numpy as np

from bench.hands.routines import TIPS, routine, with_back
from bench.report import Row, rms
from common.arrays import Bool, Float
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from master.calibrate.hand.measure import measure_hand
from master.calibrate.hand.observed import Observed

# Name, first seed, users, noise per axis [m], markers on the back: with three the palm need not rest.
SETS = (
    ("1 mm", 2000, 64, 1e-3, 1),
    ("0.5 mm", 2100, 24, 5e-4, 1),
    ("1 mm, free palm", 2200, 16, 1e-3, 3),
)
WHOLE = (0, 1, 2)


def errors(seed: int, noise_m: float, back: int) -> tuple[Float, Float, Bool]:
    """Of every length of one user: by how much it is too long, its sigma [mm], whether it is measured.

    Each (5, 6), thumb ... little: three bones, then the sums, the whole finger last; even seeds have right hands.
    """
    side = ("right", "left")[seed % 2]
    run = routine.__wrapped__(seed, side, noise_m, back=back)
    template = with_back(generated_profile("mine", side), back)
    observed = Observed.of(run.t_ns, run.points_m, run.cov_m2, run.names, HandModel.of(template))
    found = measure_hand(observed, template)
    truth, mine = run.bones_m(), found.template
    truth[:, 2] += [
        mine.mount(tip).offset_m[2] - run.model.mount(tip).offset_m[2] for tip in TIPS
    ]  # of the caps
    off = [one.length_m - truth[one.finger, list(one.bones)].sum() for one in found.lengths]
    sigma = [one.sigma_m for one in found.lengths]
    shape = 5, -1
    measured = np.reshape([one.measured for one in found.lengths], shape)
    return 1e3 * np.reshape(off, shape), 1e3 * np.reshape(sigma, shape), measured


def rows() -> Iterator[Row]:
    """Fingers measured, errors, and whether the stated uncertainties are true."""
    for name, first, users, noise_m, back in SETS:
        start_s = process_time()
        found = [errors(first + user, noise_m, back) for user in range(users)]
        seconds = (process_time() - start_s) / users
        off, sigma, measured = (np.stack(part) for part in zip(*found, strict=True))
        fingers, sure = off[:, 1:, -1], measured[:, 1:, -1]
        claimed = fingers[sure]
        yield Row(f"{name}: fingers measured", float(sure.sum()), "", f"of {sure.size}")
        yield Row(f"{name}: their errors, rms", rms(claimed), "mm", f"worst {abs(claimed).max():.2f}")
        yield Row(f"{name}: of these beyond 1 mm", float((abs(claimed) > 1.0).sum()), "")
        yield Row(f"{name}: single bones measured", float(measured[:, :, :3].sum()), "")
        for what, own, its in (
            ("fingers", fingers, sigma[:, 1:, -1]),
            ("single bones", off[:, 1:, :3], sigma[:, 1:, :3]),
            ("thumb", off[:, 0, -1], sigma[:, 0, -1]),
        ):
            within = 100.0 * float((abs(own) < 1.96 * its).mean())
            yield Row(
                f"{name}: {what} within 95 %",
                within,
                "%",
                f"squared error / variance {rms(own / its) ** 2:.2f}",
            )
            yield Row(f"{name}: {what} too long by", float(own.mean()), "mm", f"rms {rms(own):.2f}")
        yield Row(f"{name}: time of a user", seconds, "s", "of processor, the simulation with it")
