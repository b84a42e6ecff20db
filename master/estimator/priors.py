"""Priors say how a hand is held before it is measured.

Every prior is a row of a least-squares problem that is linear in the free angles, divided by its standard
deviation. Hands mostly follow joint couplings, and now and then defy them altogether: a gun, horns, a
pianist. So there are two hypotheses of every hand, *natural* and *free*, and the evidence of the markers
decides how much each counts (MacKay 1992, "Bayesian interpolation": the width of the prior is what a free
hand gains in fit and pays in volume).

Three come from Kim et al. 2012 ("Digits"). *Flexion synergy*: the MCP of a finger is 0.54 of its PIP and the
DIP 0.84 (Kamper et al. 2003), or as the hand file states; a thumb closes in proportion, from one end of its
limits to the other. *Finger line*: a finger that bends moves its laser point along a nearly straight line on
the laser plane, which a guided curl measures; the model of a hand is not stretched to that range: where the
point of a straight finger lies shows how straight it was held, 3 mm for each degree. *Cubic*: the printed law
of the distance d along that line from where it comes nearest to the device,

    PIP [deg] = -0.0003 d^3 + 0.059 d^2 - 4.07 d + 119.75        d in mm, 0 ... 102.06

As a law of any particular hand it is wrong by 12 to 20 degrees, and one digit more in 0.0003 would move its
root between 71 and 152 mm: it is here to compare with (`forward` of the rig: "cubic"). A thumb is left to the
natural curve.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float
from common.calibration.rig import FingerLine
from common.errors import CalibrationError, FitError
from common.hand.model import FINGERS, HandModel
from common.hand.profiles import ABDUCTION, FLEXION, preset_couplings
from common.kernels import kernel
from common.records import boxed, record
from master.estimator.finger_surface import OWN_MOVES, Surface, laser_centroid, look
from master.estimator.parameters import HandParameters, HandTables
from master.estimator.sensors import Device, flexed_palm
from master.estimator.settings import DEFAULT, KERNEL, LAWS, Settings
from master.fabrik.linear_algebra import as_vector
from master.rig.setup import WristSetup

Row = tuple[dict[int, float], float, float]


class PosturePrior(NamedTuple):
    """Prior on free angles x, cost x normal x / 2 - pull x + constant, H hypotheses."""

    normal: Float  # (H, n, n)
    pull: Float  # (H, n)
    constant: Float  # (H,) so that the cost is that of the squares
    log_density: Float  # (H,) at cost 0, but for what the hypotheses have in common

    def natural_component(self) -> "PosturePrior":
        """Those of the first hypothesis alone."""
        return PosturePrior(self.normal[:1], self.pull[:1], self.constant[:1], self.log_density[:1])


def posture_prior_of(
    model: HandModel,
    parameters: HandParameters,
    settings: Settings = DEFAULT,
    unlike: frozenset[int] = frozenset(),
) -> PosturePrior:
    """Return priors of a natural and a free hand; `unlike` fingers are no neighbours."""
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
        span = np.maximum(parameters.legal_high - parameters.legal_low, KERNEL.narrowest_rad)[flexion]
        # The highest density of a normal distribution of this width is that of any angle within the span.
        volume[1, flexion, flexion] += 2.0 * np.pi / span**2
    share = np.log([settings.natural_prior_weight, 1.0 - settings.natural_prior_weight])
    return PosturePrior(normal, pull, constant, share + least + 0.5 * np.linalg.slogdet(volume)[1])


def curled(parameters: HandParameters, settings: Settings, fingers: Bool) -> tuple[Float, Float]:
    """Return inverse variances and means (n,) of fingers (5,) curled out of sight."""
    angles, sigma = np.zeros((5, 4)), np.full((5, 4), np.inf)
    s = settings
    angles[0, :2] = s.curled_thumb_abduction_rad, s.curled_thumb_flexion_rad
    angles[0, 2:] = s.curled_thumb_mcp_rad, s.curled_thumb_ip_rad
    sigma[0] = settings.curled_rad
    angles[1:, 1:3] = settings.curled_flexion_rad, settings.curled_pip_rad
    sigma[1:, 1:3] = settings.curled_rad
    sigma[~fingers] = np.inf
    return parameters.free_of(sigma) ** -2.0, parameters.of_angles(angles)


def _natural_rows(model: HandModel, s: Settings, unlike: frozenset[int]) -> list[Row]:
    """Return the rows of a natural hand, by places in the flat table of angles."""
    if model.posture is not None:
        return _posture_rows(*model.posture, 1.0)
    thumb = (s.thumb_abduction_mean_rad, s.thumb_flexion_mean_rad, s.thumb_mcp_mean_rad, s.thumb_ip_mean_rad)
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
    factor = np.linalg.cholesky(np.linalg.inv(cov)).astype(np.float64)
    rows: list[Float] = list(factor.T)
    return [(dict(enumerate(map(float, row))), float(row @ mean), wider) for row in rows]


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
    """Return the row, if it follows loosely, of the DIP of the finger at angle a."""
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


def principal_line(points_m: Float) -> FingerLine:
    """Fit the line through the laser points (N, 3) [m] of one finger, in any order.

    The principal component; its origin is the point of the straightest finger, its range (0, length). NaN:
    rejected.

    Raises:
        FitError: Fewer than five points, less than 5 mm of motion, or points on no line.
    """
    points = points_m[np.isfinite(points_m).all(axis=1)]
    if len(points) < LAWS.line_points:
        raise FitError(
            f"finger line: {len(points)} points of the laser, {LAWS.line_points} or more are needed"
        )
    mean = points.mean(axis=0)
    off = points - mean
    direction = np.linalg.svd(off, full_matrices=False)[2][0]
    along = off @ direction
    ends = mean + np.array([[along.min()], [along.max()]]) * direction
    distance = np.linalg.norm(ends, axis=1)
    if distance[0] < distance[1]:  # a bending finger's point comes nearer to the camera
        direction, along = -direction, -along
    residual = float(np.sqrt(((off - along[:, None] * direction) ** 2).sum(axis=1).mean()))
    low, high = float(along.min()), float(along.max())
    if high - low < LAWS.line_range_m:
        raise FitError(
            f"finger line: the laser's point moved by {1e3 * (high - low):.1f} mm only: bend the finger fully"
        )
    if residual > LAWS.line_straight * (high - low):
        raise FitError(
            f"finger line: the points deviate {1e3 * residual:.1f} mm from a line of {1e3 * (high - low):.1f} mm:"
            " only this finger should move"
        )
    return FingerLine(
        origin_m=as_vector(mean + low * direction),
        direction=as_vector(direction),
        range_m=(0.0, high - low),
        residual_m=residual,
    )


def on_line(points_m: Float, line: FingerLine) -> tuple[Float, Float]:
    """Return normalised positions along the line, and deviations from it.

    Points (..., 3) give positions (...), from 0 straight to 1 most flexed, and deviations (..., 3) [m].
    """
    offset = points_m - np.array(line.origin_m)
    direction = np.array(line.direction)
    along = offset @ direction
    low, high = line.range_m
    return (along - low) / (high - low), offset - along[..., None] * direction


PIP, DIP = 2, 3


@dataclass(frozen=True, slots=True, eq=False)
class FlexionSynergy:
    """Angles by closing: base_rad + closing * per_pip."""

    base_rad: Float  # (5, 4)
    per_pip: Float  # (5, 4); that of the PIP (thumb MCP) is 1
    range_rad: Float  # (5, 2) of the closing

    @classmethod
    def of(cls, model: HandModel) -> "FlexionSynergy":
        """Return the synergy of a hand: its file's own couplings, or those of Digits."""
        stated = model.profile.couplings is not None
        digits = preset_couplings("D")
        mcp, dip = (model.mcp_per_pip, model.dip_per_pip) if stated else (None, None)
        base, per_pip, range_rad = np.zeros((5, 4)), np.zeros((5, 4)), np.empty((5, 2))
        per_pip[1:, FLEXION] = digits.mcp_per_pip if mcp is None else mcp
        per_pip[1:, DIP] = digits.dip_per_pip if dip is None else dip
        per_pip[:, PIP] = 1.0
        range_rad[1:] = 0.0, LAWS.closed_rad
        low, high = model.limits_rad[0, 1:].T
        span = np.maximum(high - low, KERNEL.narrowest_rad)
        per_pip[0, 1:] = span / span[1]
        base[0, 1:] = low - low[1] * per_pip[0, 1:]
        range_rad[0] = low[1], low[1] + span[1]
        return cls(base, per_pip, range_rad)

    def angles(self, curl_rad: Float, abduction_rad: Float) -> Float:
        """Angles (..., 5, 4) [rad] of closings and abductions (..., 5) [rad]."""
        angles = self.base_rad + curl_rad[..., None] * self.per_pip
        angles[..., ABDUCTION] = abduction_rad
        return angles


def cubic_pip(distance_m: Float) -> Float:
    """Return the PIP angle [rad] by the printed law, clamped outside its range."""
    d = np.clip(1e3 * distance_m, 0.0, LAWS.cubic_mm)
    return np.radians(np.clip(np.polyval(LAWS.cubic, d), 0.0, LAWS.cubic[-1]))


@kernel
def _laser_points(
    boxed_hand: Float, boxed_device: Float, angles: Float, boxed_work: Float, out: Float
) -> None:
    """Write laser points (C, 5, 3) [m] of angles (C, 20); NaN: the finger is missed."""
    palm, axes = np.zeros((4, 4)), np.zeros((2, 3))
    hand, device, work = boxed_hand[0], boxed_device[0], boxed_work[0]
    flexed_palm(device.palm, 0.0, 0.0, palm, axes)
    for c in range(angles.shape[0]):
        for f in range(5):
            look(hand, device, palm, axes, angles[c], f, OWN_MOVES, work)
            lit = laser_centroid(device, f, work) > 0.0
            for i in range(3):
                out[c, f, i] = work.laser_centroid[i] if lit else np.nan


def lit(setup: WristSetup, synergy: FlexionSynergy) -> bool:
    """Return whether the laser meets a finger that closes naturally."""
    return bool(np.isfinite(_curl(setup, synergy)[:, 1:, 0]).any())


def simulated_lines(setup: WristSetup) -> tuple[FingerLine, ...]:
    """Return the lines (5) of a whole curl of a simulated, unspread hand."""
    points = _curl(setup, FlexionSynergy.of(setup.model))
    return tuple(principal_line(points[np.isfinite(points[:, f, 0]), f]) for f in range(5))


def _curl(setup: WristSetup, synergy: FlexionSynergy) -> Float:
    """Return laser points (C, 5, 3) [m] of a hand that closes; NaN: missed."""
    model, curls = setup.model, LAWS.curls
    share = np.linspace(0.0, LAWS.curl_share, curls)[:, None]
    curl = synergy.range_rad[:, 0] + share * (synergy.range_rad[:, 1] - synergy.range_rad[:, 0])
    angles = synergy.angles(curl, np.zeros_like(curl)).reshape(curls, 20)
    points = np.empty((curls, 5, 3))
    tables = HandTables.of(model, HandParameters.of(model))
    _laser_points(boxed(tables), boxed(Device.of(setup)), angles, boxed(record(Surface)), points)
    return points


class CubicLaw:
    """Printed law that maps laser points of one device to angles."""

    def __init__(self, setup: WristSetup) -> None:
        simulated = simulated_lines(setup)
        self.lines = tuple(setup.lines.get(name, line) for name, line in zip(FINGERS, simulated, strict=True))

    def __call__(self, points_m: Float) -> Float:
        """Return PIPs (5,) [rad] of laser points (5, 3) [m]; NaN: not seen, the thumb."""
        pip = np.full(5, np.nan)
        for f, line in enumerate(self.lines[1:], start=1):
            along, _ = on_line(points_m[f], line)
            pip[f] = cubic_pip((1.0 - along) * (line.range_m[1] - line.range_m[0]))
        return pip


@dataclass(frozen=True, slots=True, eq=False)
class WristModel:
    """A wrist device, and how the fingers that it sees bend."""

    device: Device
    base_rad: Float  # (5, 4) natural angles by the PIP: base_rad + per_pip PIP
    per_pip: Float
    frame: Float  # (4,) least and most x and y of the ray of a fingertip that is clearly in the image
    frame_s: float  # from the laser's frame to that of the LEDs
    loose: bool  # whether the wrist may bend before the device
    tilt_rad: float  # by which the IMU may have the vertical off
    heading_rad: float | None  # by which its heading may be off in the beginning; None: it may be any
    natural_only: bool  # whether fingers are taken to bend naturally, whatever is seen

    @classmethod
    def of(cls, setup: WristSetup, *, loose: bool) -> "WristModel":
        """Lay out a device; `loose`: whether the wrist may bend.

        Raises:
            CalibrationError: The laser passes by the hand.
        """
        synergy, optics = FlexionSynergy.of(setup.model), setup.optics
        per_pip = synergy.per_pip.copy()
        if setup.model.profile.couplings is None and setup.solver_mode != "fk":
            per_pip[1:, DIP] = LAWS.dip_per_pip
        per_pip[0, DIP] = LAWS.ip_per_mcp
        base_rad = synergy.base_rad.copy()
        base_rad[0, DIP] = 0.0
        if not lit(setup, synergy):
            raise CalibrationError(
                "laser_plane, T_camera_palm: the laser meets no finger of this hand however it is bent: calibrate plane"
                " and palm"
            )
        size = np.array([optics.width_px, optics.height_px])
        centre = np.array([optics.matrix[0, 2], optics.matrix[1, 2]])
        focal = np.array([optics.matrix[0, 0], optics.matrix[1, 1]])
        low, high = (LAWS.inside_px - centre) / focal, (size - LAWS.inside_px - centre) / focal
        return cls(
            Device.of(setup),
            base_rad,
            per_pip,
            np.array([low[0], high[0], low[1], high[1]]),
            setup.frame_s,
            loose,
            0.0 if setup.imu is None else setup.imu.orientation_sigma_rad,
            None if setup.imu is None else setup.imu.heading_sigma_rad,
            setup.solver_mode == "fk",
        )


def loosened(model: HandModel) -> HandModel:
    """Return the hand with loosely following DIPs and room beyond its limits."""
    limits = model.limits_rad.copy()
    limits[1:, ABDUCTION] = -LAWS.abduction_rad, LAWS.abduction_rad
    limits[1:, [FLEXION, PIP, DIP], 0] -= LAWS.slack_rad
    limits[1:, [FLEXION, PIP, DIP], 1] += LAWS.slack_rad
    ratio = model.dip_per_pip
    if model.profile.couplings is None:
        ratio = LAWS.dip_per_pip
    spread = max(model.dip_spread_rad, LAWS.dip_spread_rad)
    return replace(
        model, tolerance_rad=np.zeros((5, 4)), limits_rad=limits, dip_per_pip=ratio, dip_spread_rad=spread
    )
