"""Fit the weights of `slave.markers.quality` to what the detector sees of markers and of things that are none.

    PHALANX_PHOTOS=FOLDER .venv/bin/python -m bench.quality_fit [--held-out SOURCE,...]

Prints the weights to be written into that file, and what they reach in the sources that were held out of the fit.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Final

import numpy as np

from bench.marker_evidence import Collector, Rows
from bench.marker_photos import photos
from common.arrays import Float
from slave.markers.quality import Evidence

RIDGE: Final = 1.0  # of the weights, in standard deviations of the evidence, against one detection
ROUNDS: Final = 30
FAMILIES: Final = ("painted", "rendered", "ball")  # of markers, which count alike


def fit(rows: Rows) -> Float:
    """Bias and weights (1 + K,) of a logistic regression in which markers and others count alike.

    Newton's method (iteratively reweighted least squares; McCullagh and Nelder 1989, section 4.4), with a ridge.
    """
    x, y, weight = rows.evidence, rows.right.astype(np.float64), weights_of(rows)
    scale = np.maximum(x.std(axis=0), 1e-6)
    design = np.column_stack([np.ones(len(x)), x / scale])
    ridge = RIDGE * np.diag([0.0, *np.ones(x.shape[1])])
    beta = np.zeros(design.shape[1])
    for _ in range(ROUNDS):
        p = 1.0 / (1.0 + np.exp(-np.clip(design @ beta, -30.0, 30.0)))
        gradient = design.T @ (weight * (y - p)) - ridge @ beta
        hessian = (design * (weight * p * (1.0 - p))[:, None]).T @ design + ridge
        beta = beta + np.linalg.solve(hessian, gradient)
    return np.concatenate([beta[:1], beta[1:] / scale])


def weights_of(rows: Rows) -> Float:
    """Weights (N,) with which markers and others count alike, and so does each family of markers."""
    family = np.array([source.split()[0] for source in rows.source])
    weight = np.zeros(len(family))
    groups = [rows.right & (family == name) for name in FAMILIES] + [~rows.right]
    shares = [1.0 / len(FAMILIES)] * len(FAMILIES) + [1.0]
    for group, share in zip(groups, shares, strict=True):
        if group.any():
            weight[group] = share / group.sum()
    return weight * (~rows.right).sum()


def predicted(rows: Rows, beta: Float) -> Float:
    """Probabilities (N,) by bias and weights."""
    return 1.0 / (1.0 + np.exp(-np.clip(beta[0] + rows.evidence @ beta[1:], -30.0, 30.0)))


def reliability(
    quality: Float, right: Float, weight: Float, bins: int = 5
) -> list[tuple[float, float, float]]:
    """(mean stated, found, share of all) of each bin of stated quality that is not empty."""
    bin_of = np.minimum((quality * bins).astype(int), bins - 1)
    table: list[tuple[float, float, float]] = []
    for k in range(bins):
        mine = bin_of == k
        if weight[mine].sum() > 0.0:
            stated, found = (float(np.average(v[mine], weights=weight[mine])) for v in (quality, right))
            table.append((stated, found, float(weight[mine].sum() / weight.sum())))
    return table


def collected(seed: int = 1) -> Rows:
    """Everything there is to fit to."""
    collector, rng = Collector(), np.random.default_rng(seed)
    for photo in photos():
        collector.look_at_photo(photo, rng)
    collector.look_at_rendered(rng)
    collector.look_at_ball(rng, 6)
    return collector.rows()


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit without the sources that are held out, and judge those."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.quality_fit", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument(
        "--held-out", default="", metavar="SOURCE,...", help="photographs that are not fitted to"
    )
    held = set(parser.parse_args(arguments).held_out.split(",")) - {""}
    rows = collected()
    apart = np.array([source.split()[-1] in held for source in rows.source])
    beta = fit(rows.of(~apart))
    print(f"BIAS = {beta[0]:.2f}")
    print("WEIGHTS = Evidence(")
    for name, weight in zip(Evidence._fields, beta[1:].tolist(), strict=True):
        print(f"    {name}={weight:.2f},")
    print(")")
    for title, chosen in (("fitted to", ~apart), ("held out", apart)):
        if chosen.any():
            part = rows.of(chosen)
            p = predicted(part, beta)
            plain = np.array([source.startswith("photo ") for source in part.source])
            count = sum(n for source, n in rows.photos.items() if (source in held) == (title == "held out"))
            print(f"{title}: {len(p)} detections; {(p[plain] > 0.5).sum() / max(count, 1):.2f} false of quality above "
                  f"0.5 in a photograph ({plain.sum() / max(count, 1):.2f} of any, {count} photographs)")  # fmt: skip
            for family in sorted({source.split()[0] for source in part.source}):
                mine = np.array([source.split()[0] == family for source in part.source])
                for right in (True, False):
                    some = mine & (part.right == right)
                    if some.any():
                        print(f"  {family:9s} {'markers' if right else 'others ':8s} {some.sum():5d}: quality median "
                              f"{np.median(p[some]):.2f}, above 0.5 {np.mean(p[some] > 0.5):.3f}")  # fmt: skip
            for stated, found, share in reliability(p, part.right.astype(np.float64), weights_of(part)):
                print(f"  stated {stated:.2f}: right {found:.2f} ({100.0 * share:.0f} %)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
