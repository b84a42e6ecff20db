"""A search along each bend of a finger gives its probability density.

Laser point and fingertip hold a finger's angles in some directions well and in others hardly: near the turn
of a fingertip's way in the image straighter and more bent fingers show almost the same, and without a tip
only the prior constrains it. A finger's posterior may be long, bent, and in two parts, and no descent from
one start finds it. For each PIP of a grid the other unknowns (abduction, flexion, DIP and twist of its
hinges) get their least chi square; what is left of the residuals is interpolated between the nodes; and the
density over the PIP is, with the others integrated out (Laplace; MacKay, "Information Theory, Inference, and
Learning Algorithms", 27),

    exp(-chi2 / 2) |S|^1/2 p(flexion, PIP)         S: covariance of the others at that PIP

p is a mixture of three hands: a *natural* one, whose flexion follows the PIP, a *straight* one, whose fingers
are stretched while they bend in their knuckles ("intrinsic plus" in hand surgery), and a *free* one, whose
joints know nothing of each other. Fingers whose tips are seen decide which of them it is. Of a density in
several parts the heaviest, by where the finger was, is taken, and the covariance holds all of them.
"""

from math import exp, inf, isfinite, log, pi, sqrt

from common.arrays import Float, Int
from common.kernels import inlined, inner
from common.records import array, part
from master.estimator.finger_surface import NO_MOVES, OWN_MOVES, Surface, first_hit, laser_centroid, look
from master.estimator.kinematics import twist_hand
from master.estimator.parameters import HandTables
from master.estimator.problem import Rig
from master.estimator.sensors import CycleRows
from master.estimator.settings import KERNEL, Settings
from master.fabrik.linear_algebra import cholesky, substitute

NODES, FINE = KERNEL.nodes, KERNEL.fine
_PLACES = FINE * (NODES - 1) + 1  # of a density, in fine steps
ROWS, HANDS = 8, 3  # laser 2, tip 2, depth, abduction, DIP, twist; as of `_NATURAL`


class Prior:
    """Prior of the fingers before a strobe cycle is seen."""

    palm: Float = array(4, 4)  # camera frame
    wrist_axes: Float = array(2, 3)  # as of `flexed_palm`
    twist: Float = array(5)  # mean of the twist of the hinges [rad], and `twist2` its variance
    twist2: Float = array(5)
    light: Float = array(1)  # mean of the logarithm of the light's unit, and `light2` its variance
    light2: Float = array(1)
    base_rad: Float = array(5, 4)  # natural angles by the PIP: base_rad + per_pip PIP
    per_pip: Float = array(5, 4)
    abduction: Float = array(5)  # standard deviations [rad] about them, as `flexion`
    flexion: Float = array(5)
    coupled_share: Float = array(1)  # of the PIP by which this MCP bends more (`wrist_update`),
    coupled_spread: Float = array(1)  # and within how much of it
    last: Float = array(5)  # PIPs expected [rad],
    process_noise: Float = array(5)  # how far from there they may be,
    had_previous: Float = array(5)  # and whether they are expected anywhere
    window_rad: Float = array(5)  # how far from there a finger that is well known is searched; 0: everywhere
    natural_only: Float = array(1)  # 1: fingers are taken to bend naturally (level "fk")
    law: Float = array(5)  # PIPs by another law [rad]; NaN: none
    frame: Float = array(4)  # least and most x and y of a fingertip that is clearly in the image


class Scan:
    """Estimates of five fingers along their minima, for every PIP."""

    x: Float = array(5, NODES, 5)  # angles and twist [rad] at each PIP
    rows: Float = array(5, NODES, ROWS)  # residuals in their standard deviations
    volume: Float = array(5, NODES)  # logarithm of |S|^1/2
    flexion2: Float = array(5, NODES)  # variance of the flexion
    length_px: Float = array(5, NODES)  # of the laser's line
    lack: Float = array(5, NODES, 2)  # of the ridge to the cut
    hand: Float = array(5, HANDS)  # logarithm of the evidence of each hand
    share: Float = array(HANDS)  # probabilities of the hands
    p: Float = array(_PLACES)  # density of one finger
    weighted: Float = array(_PLACES)  # that by which its place is chosen
    log_p: Float = array(5, HANDS, _PLACES)  # logarithm of the density of each finger, fine, by hand
    out: Float = array(5, 5)  # angles and twist chosen
    mode: Float = array(5, 5)  # of the most likely pose of that part
    way: Float = array(5, 5)  # derivative of these by the PIP there
    pip2: Float = array(5)  # variance of the PIP
    chi2: Float = array(5)  # of the best node; of none: infinite
    parts: Float = array(5)  # how many parts a density has that count
    known: Float = array(5)  # whether the finger was scanned
    first: Int = array(5, kind="i8")  # node where the search of the minimum began, and `last` where it ended
    last: Int = array(5, kind="i8")
    showing: Float = array(5, NODES)  # 1 where the fingertip would be in sight
    angles: Float = array(20)
    H: Float = array(4, 4)
    L: Float = array(4, 4)
    g: Float = array(4)
    S: Float = array(4, 4)
    J: Float = array(8, 4)
    r: Float = array(8)
    twist: Float = array(5)
    surface: Surface = part(Surface)


@inlined
def _column(u: int) -> int:
    """Which of `MOVES` unknown u is: abduction, flexion, DIP, twist."""
    return u if u < 2 else u + 1


@inlined
def _dip_sigma(settings: Settings, f: int, pip: float) -> float:
    """Standard deviation of the DIP, of a thumb its IP, about what goes with the PIP."""
    return (
        sqrt(settings.dip_rad**2 + (settings.dip_share * pip) ** 2) if f > 0 else settings.thumb_coupled_rad
    )


@inner
def _rows(rig: Rig, lines: CycleRows, prior: Prior, f: int, scan: Scan) -> float:
    """Write residuals (8,), derivatives (8, 4) by `look`; return half chi square."""
    seen, G, r, J, a = scan.surface.seen, scan.surface.J, scan.r, scan.J, scan.angles
    for i in range(ROWS):
        r[i] = 0.0
        for u in range(4):
            J[i, u] = 0.0
    W = lines.laser_W[f]
    p = sqrt(W[0, 0])
    q = W[1, 0] / p
    d = sqrt(max(W[1, 1] - q * q, 0.0))
    r0 = seen[0] + lines.lack[f, 0] - lines.laser[f, 0]
    r1 = seen[1] + lines.lack[f, 1] - lines.laser[f, 1]
    r[0], r[1] = p * r0 + q * r1, d * r1
    for u in range(4):
        c = _column(u)
        J[0, u], J[1, u] = p * G[0, c] + q * G[1, c], d * G[1, c]
    if lines.shown[f] > 0.0:
        p = sqrt(lines.tip_W[f, 0, 0])
        r[2], r[3] = p * (seen[2] - lines.tip[f, 0]), p * (seen[3] - lines.tip[f, 1])
        w = lines.depth_w2[f]
        if w > 0.0 and prior.light2[0] < 1.0:
            w = sqrt(1.0 / (1.0 / w + prior.light2[0]))
            r[4] = w * (seen[4] + prior.light[0] - lines.depth[f])
        else:
            w = 0.0
        for u in range(4):
            c = _column(u)
            J[2, u], J[3, u], J[4, u] = p * G[2, c], p * G[3, c], w * G[4, c]
    pip = a[4 * f + 2]
    r[5] = (a[4 * f] - prior.base_rad[f, 0] - prior.per_pip[f, 0] * pip) / prior.abduction[f]
    J[5, 0] = 1.0 / prior.abduction[f]
    sigma = _dip_sigma(rig.settings, f, pip)
    r[6] = (a[4 * f + 3] - prior.base_rad[f, 3] - prior.per_pip[f, 3] * pip) / sigma
    J[6, 2] = 1.0 / sigma
    r[7] = (scan.twist[f] - prior.twist[f]) / sqrt(prior.twist2[f])
    J[7, 3] = 1.0 / sqrt(prior.twist2[f])
    total = 0.0
    for i in range(ROWS):
        total += r[i] * r[i]
    return 0.5 * total


@inner
def _factor(scan: Scan) -> bool:
    """Factor the normal matrix (4, 4) of the rows; write the gradient."""
    for u in range(4):
        scan.g[u] = 0.0
        for v in range(4):
            anywhere_rad = 2.0  # of a flexion of which nothing is known
            scan.H[u, v] = anywhere_rad**-2 if u == v and u == 1 else 0.0
        for i in range(ROWS):
            scan.g[u] += scan.J[i, u] * scan.r[i]
            for v in range(u + 1):
                scan.H[u, v] += scan.J[i, u] * scan.J[i, v]
    return cholesky(scan.H, 4, scan.L)


@inlined
def _put(hand: HandTables, f: int, x0: float, x1: float, x3: float, twist: float, scan: Scan) -> None:
    """Set abduction, flexion, DIP and twist of finger f, inside the limits."""
    a = scan.angles
    a[4 * f] = min(max(x0, hand.limits[f, 0, 0]), hand.limits[f, 0, 1])
    a[4 * f + 1] = min(max(x1, hand.limits[f, 1, 0]), hand.limits[f, 1, 1])
    a[4 * f + 3] = min(max(x3, hand.limits[f, 3, 0]), hand.limits[f, 3, 1])
    scan.twist[f] = min(max(twist, -KERNEL.rolled_rad), KERNEL.rolled_rad)
    twist_hand(hand, scan.twist)


@inlined
def _look(rig: Rig, prior: Prior, f: int, moves: int, scan: Scan) -> None:
    look(rig.hand, rig.device, prior.palm, prior.wrist_axes, scan.angles, f, moves, scan.surface)


@inner
def scan_finger(rig: Rig, lines: CycleRows, prior: Prior, f: int, scan: Scan) -> None:
    """Write the minimum of finger f along its PIPs, from `Scan.x` to `chi2`."""
    low, high = rig.hand.limits[f, 2, 0], rig.hand.limits[f, 2, 1]
    scan.chi2[f] = inf
    first, last = 0, NODES - 1
    if prior.window_rad[f] > 0.0:
        step = (high - low) / (NODES - 1)
        first = min(max(int((prior.last[f] - prior.window_rad[f] - low) / step), 0), NODES - 3)
        last = max(int((prior.last[f] + prior.window_rad[f] - low) / step) + 1, first + 2)
        last = min(last, NODES - 1)
    scan.first[f], scan.last[f] = first, last
    for node in range(first, last + 1):
        scan.angles[4 * f + 2] = low + (high - low) * node / (NODES - 1)
        lines.lack[f, 0] = lines.lack[f, 1] = 0.0
        steps = _start(rig, lines, prior, f, node, scan)
        cost, length = _descend(rig, lines, prior, f, steps, scan)
        _keep(rig, lines, prior, f, node, length, scan)
        scan.chi2[f] = min(scan.chi2[f], 2.0 * cost)
    # Where a node happens to lie on a turn of the ridge, its volume is of that pose alone.
    for node in range(first + 1, last):
        most = max(scan.volume[f, node - 1], scan.volume[f, node + 1])
        scan.volume[f, node] = min(scan.volume[f, node], most)
    scan.known[f] = 1.0


@inner
def _start(rig: Rig, lines: CycleRows, prior: Prior, f: int, node: int, scan: Scan) -> int:
    """Set the pose from which a node is searched; return in how many steps.

    From the pose of the PIP before; at the first node, and every few others, rather from one that is tried.
    """
    pip, tried = scan.angles[4 * f + 2], len(KERNEL.tried_rad)
    dip = prior.base_rad[f, 3] + prior.per_pip[f, 3] * pip
    abduction = prior.base_rad[f, 0] + prior.per_pip[f, 0] * pip
    best, at = inf, tried
    if (node - scan.first[f]) % KERNEL.tried_every == 0:
        for start in range(tried):
            _put(rig.hand, f, abduction, KERNEL.tried_rad[start], dip, prior.twist[f], scan)
            _look(rig, prior, f, NO_MOVES, scan)
            cost = _rows(rig, lines, prior, f, scan)
            if cost < best:
                best, at = cost, start
    if node > scan.first[f]:
        before = scan.x[f, node - 1]
        _put(rig.hand, f, before[0], before[1], before[3], before[4], scan)
        if at < tried:
            _look(rig, prior, f, NO_MOVES, scan)
            at = tried if _rows(rig, lines, prior, f, scan) < best else at
    if at < tried:
        _put(rig.hand, f, abduction, KERNEL.tried_rad[at], dip, prior.twist[f], scan)
    return KERNEL.steps_from_node if at == tried else KERNEL.steps_from_tried


@inner
def _descend(rig: Rig, lines: CycleRows, prior: Prior, f: int, steps: int, scan: Scan) -> tuple[float, float]:
    """Search the minimum at one PIP; return half chi square and line length [px]."""
    a, surface, step, length, cost = scan.angles, scan.surface, scan.S[0], 0.0, 0.0
    for k in range(steps + 1):
        _look(rig, prior, f, OWN_MOVES, scan)
        if k == steps - 1:
            length = laser_centroid(rig.device, f, surface)
            if length > 0.0:
                exact = surface.laser_centroid
                lines.lack[f, 0] = exact[0] / exact[2] - surface.seen[0]
                lines.lack[f, 1] = exact[1] / exact[2] - surface.seen[1]
        cost = _rows(rig, lines, prior, f, scan)
        if not _factor(scan) or k == steps:
            break
        for u in range(4):
            step[u] = -scan.g[u]
        substitute(scan.L, 4, step)
        for u in range(4):
            step[u] = min(max(step[u], -KERNEL.step_rad), KERNEL.step_rad)
        abduction, flexion, dip = a[4 * f] + step[0], a[4 * f + 1] + step[1], a[4 * f + 3] + step[2]
        _put(rig.hand, f, abduction, flexion, dip, scan.twist[f] + step[3], scan)
    return cost, length


@inner
def _keep(rig: Rig, lines: CycleRows, prior: Prior, f: int, node: int, length: float, scan: Scan) -> None:
    """Write where the search at a node has ended."""
    for k in range(4):
        scan.x[f, node, k] = scan.angles[4 * f + k]
    scan.x[f, node, 4] = scan.twist[f]
    volume = 0.0
    for u in range(4):
        volume -= log(scan.L[u, u])
        scan.S[0, u] = 1.0 if u == 1 else 0.0
    scan.volume[f, node] = volume - log(_dip_sigma(rig.settings, f, scan.angles[4 * f + 2]))
    substitute(scan.L, 4, scan.S[0])
    scan.flexion2[f, node] = scan.S[0, 1]
    scan.length_px[f, node] = length
    scan.lack[f, node, 0], scan.lack[f, node, 1] = lines.lack[f, 0], lines.lack[f, 1]
    for i in range(ROWS):
        scan.rows[f, node, i] = scan.r[i]
    scan.showing[f, node] = 1.0 if _shows(prior, length, scan) else 0.0


@inner
def _shows(prior: Prior, length: float, scan: Scan) -> bool:
    """Return whether the fingertip that `look` left is clearly in sight."""
    t = scan.surface.tip
    if not t[2] > 0.0:
        return False
    x, y = t[0] / t[2], t[1] / t[2]
    if not (prior.frame[0] < x < prior.frame[1] and prior.frame[2] < y < prior.frame[3]):
        return False
    if length == 0.0:
        return True
    away = sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    for k in range(7):
        if first_hit(scan.surface.camera[k], t[0] / away, t[1] / away, t[2] / away) < away - KERNEL.hidden_m:
            return False
    return True


_NATURAL, _STRAIGHT, _FREE = 0, 1, 2


@inlined
def _normal_log(off: float, variance: float) -> float:
    return _by_width(off, variance, 0.5 * log(2.0 * pi * variance))


@inlined
def _by_width(off: float, variance: float, width: float) -> float:
    """`_normal_log`, where half the logarithm of 2 pi variance is known."""
    return -0.5 * off * off / variance - width


@inner
def _densities(rig: Rig, prior: Prior, f: int, unseen: bool, scan: Scan) -> None:
    """Write the logarithm of the density of finger f (3, 61), by hand."""
    hand, settings, log_p = rig.hand, rig.settings, scan.log_p[f]
    low, high = hand.limits[f, 2, 0], hand.limits[f, 2, 1]
    span, length = log(hand.limits[f, 1, 1] - hand.limits[f, 1, 0]), log(high - low)
    free2, straight2 = settings.free_pip_rad**2, settings.straight_pip_rad**2
    free_width, straight_width = 0.5 * log(2.0 * pi * free2), 0.5 * log(2.0 * pi * straight2)
    for k in range(_PLACES):
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
            row = _between(share, scan.rows[f, node, i], scan.rows[f, node + 1, i])
            chi2 += row * row
        base = -0.5 * chi2 + (1.0 - share) * scan.volume[f, node] + share * scan.volume[f, node + 1]
        flexion = _between(share, scan.x[f, node, 1], scan.x[f, node + 1, 1])
        flexion2 = _between(share, scan.flexion2[f, node], scan.flexion2[f, node + 1])
        if unseen:
            shows = _between(share, scan.showing[f, node], scan.showing[f, node + 1])
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
def weigh_hands(rig: Rig, lines: CycleRows, prior: Prior, scan: Scan) -> None:
    """Write each hand's evidence by fingers whose tips are seen, and probabilities."""
    others, share, natural = 0, scan.share, rig.settings.natural_finger_weight
    for f in range(1, 5):
        others += 1 if lines.shown[f] > 0.0 else 0
    share[_NATURAL] = log(natural)
    share[_STRAIGHT] = share[_FREE] = log(0.5 * (1.0 - natural))
    for f in range(5):
        if scan.known[f] == 0.0:
            continue
        _densities(rig, prior, f, others > 0 and lines.shown[f] == 0.0, scan)
        for h in range(HANDS):
            top, total = -inf, 0.0
            for k in range(_PLACES):
                top = max(top, scan.log_p[f, h, k])
            for k in range(_PLACES):
                total += exp(scan.log_p[f, h, k] - top)
            scan.hand[f, h] = log(total) + top
            if f > 0 and lines.shown[f] > 0.0:
                share[h] += scan.hand[f, h]
    if prior.natural_only[0] > 0.0:
        share[_STRAIGHT] = share[_FREE] = -inf
    top, total = max(share[0], max(share[1], share[2])), 0.0
    for h in range(HANDS):
        share[h] = exp(share[h] - top)
        total += share[h]
    for h in range(HANDS):
        share[h] /= total


@inlined
def _between(share: float, here: float, there: float) -> float:
    return (1.0 - share) * here + share * there


@inlined
def _at(scan: Scan, f: int, place: float, out: Float) -> None:
    """Write the pose (5,) of finger f at a place of its minimum, in fine steps."""
    node = min(int(place / FINE), NODES - 2)
    share = place / FINE - node
    for k in range(5):
        out[k] = _between(share, scan.x[f, node, k], scan.x[f, node + 1, k])


@inner
def choose(rig: Rig, lines: CycleRows, prior: Prior, f: int, scan: Scan) -> None:
    """Write the estimate of finger f from the densities that `weigh_hands` left.

    It is the median of the part that weighs most, its likeliest pose, and the spread. Where frames follow
    each other, a part near to where the finger was is preferred.
    """
    low, high = rig.hand.limits[f, 2, 0], rig.hand.limits[f, 2, 1]
    step = (high - low) / (_PLACES - 1)
    _mix(prior, f, low, step, scan)
    place, crest_at = _heaviest(rig.settings, f, scan)
    _at(scan, f, place, scan.out[f])
    _at(scan, f, float(crest_at), scan.mode[f])
    node = min(max(int(place / FINE), 0), NODES - 2)
    away = scan.x[f, node + 1, 2] - scan.x[f, node, 2]
    for k in range(5):
        scan.way[f, k] = (scan.x[f, node + 1, k] - scan.x[f, node, k]) / away
    scan.pip2[f] = 0.0
    for k in range(_PLACES):
        off = low + k * step - scan.out[f, 2]
        scan.pip2[f] += scan.p[k] * off * off
    if isfinite(prior.law[f]):
        for k in range(1, 4):
            scan.out[f, k] = scan.mode[f, k] = prior.base_rad[f, k] + prior.per_pip[f, k] * prior.law[f]
    share = place / FINE - node
    for i in range(2):
        lines.lack[f, i] = _between(share, scan.lack[f, node, i], scan.lack[f, node + 1, i])


@inlined
def _mix(prior: Prior, f: int, low: float, step: float, scan: Scan) -> None:
    """Write the density `p` of all hands; by `weighted` its place is chosen."""
    p, total = scan.p, 0.0
    for k in range(_PLACES):
        p[k] = 0.0
        for h in range(HANDS):
            if scan.share[h] > 0.0:
                p[k] += scan.share[h] * exp(scan.log_p[f, h, k] - scan.hand[f, h])
        total += p[k]
    for k in range(_PLACES):
        p[k] /= total
        off = (low + k * step - prior.last[f]) / prior.process_noise[f]
        scan.weighted[k] = p[k] * exp(-0.5 * off * off) if prior.had_previous[f] > 0.0 else p[k]


@inlined
def _part(settings: Settings, begin: int, weighted: Float) -> int:
    """Return the end of the part of a density that begins there.

    Two tops are of one part where the density does not fall clearly between them. From `begin` up to the
    lowest place before another top, if it clearly falls below both.
    """
    crest, lowest, low_at = weighted[begin], inf, begin
    for k in range(begin, _PLACES):
        if lowest < settings.parted * min(crest, weighted[k]):
            return low_at
        if weighted[k] > crest:
            crest, lowest = weighted[k], inf
        elif weighted[k] < lowest:
            lowest, low_at = weighted[k], k
    return _PLACES


@inner
def _heaviest(settings: Settings, f: int, scan: Scan) -> tuple[float, int]:
    """Return median and top of the heaviest part, in fine steps, and count parts."""
    p, weighted, begin, best_begin, best_end, best, parts = scan.p, scan.weighted, 0, 0, _PLACES, -1.0, 0
    while begin < _PLACES:
        end = _part(settings, begin, weighted)
        weight = likely = 0.0
        for k in range(begin, end):
            weight += p[k]
            likely += weighted[k]
        if weight > settings.other_part:
            parts += 1
        if likely > best:
            best, best_begin, best_end = likely, begin, end
        begin = end
    scan.parts[f] = parts
    half, place, crest, crest_at, found = 0.0, float(best_begin), -1.0, best_begin, False
    for k in range(best_begin, best_end):
        if p[k] > crest:
            crest, crest_at = p[k], k
        if not found and half + weighted[k] >= 0.5 * best:
            place = k - 0.5 + (0.5 * best - half) / max(weighted[k], 1e-300)
            found = True
        half += weighted[k]
    return min(max(place, 0.0), _PLACES - 1.0), crest_at
