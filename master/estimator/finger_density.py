"""Kernels of the probability density of a finger along its minimum over PIP.

They give densities by hand, and the pose that is taken.

Three hands are weighed (`master.estimator.finger_scan`): natural, straight and free ones. Fingers whose tips are seen
decide which of them it is. A density may have several parts; the heaviest, by where the finger was, is taken,
and the covariance holds all of them.
"""

from math import exp, inf, isfinite, log, pi

from common.arrays import Float
from common.kernels import inlined, inner
from master.estimator.finger_scan import FINE, HANDS, NODES, ROWS, Prior, Scan
from master.estimator.hand_tables import HandTables
from master.estimator.settings import Settings
from master.estimator.wrist_device import LinesOfSight

_NATURAL, _STRAIGHT, _FREE = 0, 1, 2


@inlined
def _normal_log(off: float, variance: float) -> float:
    return _by_width(off, variance, 0.5 * log(2.0 * pi * variance))


@inlined
def _by_width(off: float, variance: float, width: float) -> float:
    """`_normal_log`, where half the logarithm of 2 pi variance is known."""
    return -0.5 * off * off / variance - width


@inner
def _densities(hand: HandTables, settings: Settings, prior: Prior, f: int, unseen: bool, scan: Scan) -> None:
    """Write the logarithm of the density of finger f (3, 61), by hand."""
    log_p = scan.log_p[f]
    low, high = hand.limits[f, 2, 0], hand.limits[f, 2, 1]
    span, length = log(hand.limits[f, 1, 1] - hand.limits[f, 1, 0]), log(high - low)
    free2, straight2 = settings.free_pip_rad**2, settings.straight_pip_rad**2
    free_width, straight_width = 0.5 * log(2.0 * pi * free2), 0.5 * log(2.0 * pi * straight2)
    for k in range(FINE * (NODES - 1) + 1):
        node = min(k // FINE, NODES - 2)
        share = k / FINE - node
        pip = low + (high - low) * k / (FINE * (NODES - 1))
        if node < scan.first[f] or node + 1 > scan.last[f]:
            for h in range(HANDS):
                far = 1e9  # logarithm of what is not searched
                log_p[h, k] = -far
            continue
        chi2 = 0.0
        for i in range(ROWS):
            row = (1.0 - share) * scan.rows[f, node, i] + share * scan.rows[f, node + 1, i]
            chi2 += row * row
        base = -0.5 * chi2 + (1.0 - share) * scan.volume[f, node] + share * scan.volume[f, node + 1]
        flexion = (1.0 - share) * scan.x[f, node, 1] + share * scan.x[f, node + 1, 1]
        flexion2 = (1.0 - share) * scan.flexion2[f, node] + share * scan.flexion2[f, node + 1]
        if unseen:
            shows = (1.0 - share) * scan.showing[f, node] + share * scan.showing[f, node + 1]
            base -= (settings.unseen_again if prior.had_previous[f] > 0.0 else settings.unseen) * shows
        off = flexion - prior.base_rad[f, 1] - prior.per_pip[f, 1] * pip
        variance = prior.flexion[f] ** 2 + flexion2
        if f > 0 and prior.natural_only[0] == 0.0:
            off -= prior.coupled_share[0] * pip
            variance += (prior.coupled_spread[0] * max(pip, 0.0)) ** 2
        natural = _normal_log(off, variance)
        log_p[_NATURAL, k] = base + natural - length
        free = _by_width(pip - settings.free_pip_mean_rad, free2, free_width) - span
        log_p[_FREE, k] = base + free
        straight = log(2.0) + _by_width(pip, straight2, straight_width) - span
        log_p[_STRAIGHT, k] = base + (straight if f > 0 else free)


@inner
def weigh_hands(
    hand: HandTables, settings: Settings, lines_of_sight: LinesOfSight, prior: Prior, scan: Scan
) -> None:
    """Write the evidence of each hand by each finger.

    Write also the probabilities of the hands.

    A finger measured by the laser alone does not count: it is explained by any.
    """
    others = 0
    for f in range(1, 5):
        others += 1 if lines_of_sight.shown[f] > 0.0 else 0
    scan.share[_NATURAL] = log(settings.natural_finger_weight)
    scan.share[_STRAIGHT] = scan.share[_FREE] = log(0.5 * (1.0 - settings.natural_finger_weight))
    for f in range(5):
        if scan.known[f] == 0.0:
            continue
        _densities(hand, settings, prior, f, others > 0 and lines_of_sight.shown[f] == 0.0, scan)
        for h in range(HANDS):
            top = -inf
            for k in range(FINE * (NODES - 1) + 1):
                top = max(top, scan.log_p[f, h, k])
            total = 0.0
            for k in range(FINE * (NODES - 1) + 1):
                total += exp(scan.log_p[f, h, k] - top)
            scan.hand[f, h] = log(total) + top
            if f > 0 and lines_of_sight.shown[f] > 0.0:
                scan.share[h] += scan.hand[f, h]
    if prior.natural_only[0] > 0.0:
        scan.share[_STRAIGHT] = scan.share[_FREE] = -inf
    top = max(scan.share[0], max(scan.share[1], scan.share[2]))
    total = 0.0
    for h in range(HANDS):
        scan.share[h] = exp(scan.share[h] - top)
        total += scan.share[h]
    for h in range(HANDS):
        scan.share[h] /= total


@inlined
def _at(scan: Scan, f: int, place: float, out: Float) -> None:
    """Write the pose (5,) of finger f at a place along its minimum.

    The place is counted in fine steps.
    """
    node = min(int(place / FINE), NODES - 2)
    share = place / FINE - node
    for k in range(5):
        out[k] = (1.0 - share) * scan.x[f, node, k] + share * scan.x[f, node + 1, k]


@inner
def choose(
    hand: HandTables, settings: Settings, lines_of_sight: LinesOfSight, prior: Prior, f: int, scan: Scan
) -> None:
    """Write the estimate of finger f from its density.

    It is the median of the part that weighs most, its likeliest pose, and the spread.

    By the densities that `weigh_hands` left.

    Two tops are of one part where the density does not fall clearly between them. Where frames follow each other, a
    part near to where the finger was is preferred.
    """
    count, p = FINE * (NODES - 1) + 1, scan.p
    low, high = hand.limits[f, 2, 0], hand.limits[f, 2, 1]
    step = (high - low) / (count - 1)
    total = 0.0
    for k in range(count):
        p[k] = 0.0
        for h in range(HANDS):
            if scan.share[h] > 0.0:
                p[k] += scan.share[h] * exp(scan.log_p[f, h, k] - scan.hand[f, h])
        total += p[k]
    for k in range(count):
        p[k] /= total
        off = (low + k * step - prior.last[f]) / prior.process_noise[f]
        scan.near[k] = p[k] * exp(-0.5 * off * off) if prior.had_previous[f] > 0.0 else p[k]
    # Parts: the density is walked from top to top.
    begin, best_begin, best_end, best, parts = 0, 0, count, -1.0, 0
    while begin < count:
        # From `begin` up to the lowest place before another top, if the density clearly falls below both.
        near = scan.near
        crest, lowest, low_at, end = near[begin], inf, begin, count
        for k in range(begin, count):
            if lowest < settings.parted * min(crest, near[k]):
                end = low_at
                break
            if near[k] > crest:
                crest, lowest = near[k], inf
            elif near[k] < lowest:
                lowest, low_at = near[k], k
        weight = likely = 0.0
        for k in range(begin, end):
            weight += p[k]
            likely += scan.near[k]
        if weight > settings.other_part:
            parts += 1
        if likely > best:
            best, best_begin, best_end = likely, begin, end
        begin = end
    half, place, crest, crest_at = 0.0, float(best_begin), -1.0, best_begin
    found = False
    for k in range(best_begin, best_end):
        if p[k] > crest:
            crest, crest_at = p[k], k
        if not found and half + scan.near[k] >= 0.5 * best:
            place = k - 0.5 + (0.5 * best - half) / max(scan.near[k], 1e-300)
            found = True
        half += scan.near[k]
    place = min(max(place, 0.0), count - 1.0)
    _at(scan, f, place, scan.out[f])
    _at(scan, f, float(crest_at), scan.mode[f])
    node = min(max(int(place / FINE), 0), NODES - 2)
    away = scan.x[f, node + 1, 2] - scan.x[f, node, 2]
    for k in range(5):
        scan.way[f, k] = (scan.x[f, node + 1, k] - scan.x[f, node, k]) / away
    scan.pip2[f] = 0.0
    for k in range(count):
        off = low + k * step - scan.out[f, 2]
        scan.pip2[f] += p[k] * off * off
    scan.parts[f] = parts
    if isfinite(prior.law[f]):
        for k in range(1, 4):
            scan.out[f, k] = scan.mode[f, k] = prior.base_rad[f, k] + prior.per_pip[f, k] * prior.law[f]
    share = place / FINE - node
    for i in range(2):
        lines_of_sight.lack[f, i] = (1.0 - share) * scan.lack[f, node, i] + share * scan.lack[f, node + 1, i]
