"""All tuning numbers of the card's line, with unit and reason.

Kernels have them compiled in, and numba sees no change of another file: after one, `make install` compiles anew.
"""

from math import pi, radians
from typing import NamedTuple

from scipy.special import chdtri

from common.messages.parts import MAX_TIME_NS

NEVER_NS = -MAX_TIME_NS  # before every message


class SyncSettings(NamedTuple):
    """Numbers of epochs, and of the propagation of markers to them."""

    history: int = 8  # frames of each camera that are kept
    observations: int = 4  # frames of one marker that are used: a fifth is too long ago to constrain anything
    # what is farther away a frame later is another thing
    leap_m_s: float = 5.0
    leap_px: float = 5.0
    swapped: float = 3.0  # times nearer to the other track: the slave's names are contradicted
    # Frames show the same cap in the same light, behind the same finger: most of an error stays from frame to
    # frame, and no mean removes it. New in each is at most this part of the variance that the slave states, and
    # this much.
    independent_share: float = 0.7
    independent_px: float = 0.1
    evidence: float = 0.5  # what frames so alike count of as many independent ones
    # An error in time lies along the motion. One number for both axes cannot hold it: all of it covers too much
    # (98-99 %), half, which keeps the sum of the axes, too little where the motion is along the baseline (87 %);
    # this 93-97 %.
    along: float = 0.75
    least_px: float = 0.01  # standard deviation of a centroid
    # What hands do, per axis, as measured on recorded hands (docs/sync.md): laid down, gentle, brisk.
    speed_m_s: tuple[float, float, float] = (0.01, 1.0, 1.0)
    acceleration_m_s2: tuple[float, float, float] = (0.3, 1.5, 15.0)
    jerk_1_s: float = 18.0  # by acceleration, and snap by jerk
    silent_frames: int = 12  # of each other camera since the last of one that is silent
    slow: float = 2.2  # times as many frames of others as the files state, between so many of its own
    slow_frames: int = 4
    deadline: float = 1.25  # periods that an epoch is waited for
    carried: float = 0.25  # periods beyond the observations that a frame may be away
    away_m: float = 0.5  # where hands are, for what a camera makes of their motion


class RaySettings(NamedTuple):
    """Numbers of triangulation by rays.

    `rig_px`: what lens, mount and calibration leave at one marker, for the gate alone: two sure cameras may
    miss each other by 6 px. Cheap lenses fit to about half a pixel, and a mount gives way when touched.
    `ambiguous`: 1 in 100 by chance, one degree of freedom. `common`: rendered and detected: 0.7 of all
    together, 0.8 by medians, of single fingers 0.3 (little) to 0.8 (index).
    """

    rig_px: float = 0.85  # standard deviation per axis
    false_alarm: float = 1e-6  # probability that noise alone exceeds the gate: 4.9 sigma for two cameras
    ambiguous: float = float(chdtri(1, 0.01))  # least difference in chi-square of two outliers
    common: float = 0.75  # part of the variance of whole caps' centroids that is the same in all cameras
    common_px: float = 0.1  # above it a slave reports occlusion, or time adds its own: not common
    steps: int = 8  # of Gauss-Newton; from the linear solution three are the rule
    sigma_px: float = 0.1  # of a centroid of which nothing else is stated


class AssociationSettings(NamedTuple):
    """Numbers of the association.

    `overrule`: 1 in 100 by chance, one degree of freedom. `past_most`: more than one camera, less than two.
    """

    overrule: float = float(chdtri(1, 0.01))  # least gain in chi-square for each camera that is overruled
    past_most: float = 1.5 * float(chdtri(1, 0.01))  # largest cost of the distance from the past
    false_alarm: float = 1e-6  # probability that noise alone is farther from a prediction than the gate
    most_cameras: int = 5  # with an alternative that are combined: 32 combinations; more are rejected
    same_m: float = 0.02  # combinations whose points are nearer are one thing: a finger's width
    place_m: float = 0.01  # standard deviation of a marker's place a moment ago
    speed_m_s: float = 1.0  # standard deviation of a marker's speed
    forget_s: float = 0.5  # age from which a past place is not used
    model_m: float = 0.015  # standard deviation of a marker's place by its hand's others
    spread_m: float = 0.1  # standard deviation of a marker's distance from the middle of an unsolved hand


class CapSettings(NamedTuple):
    """Numbers of the caps' observation model.

    `alike_share`: what edges of two blobs of 200 px do not explain. `least_hidden`: what hides a part from
    one camera is near the line of sight of the others, and none of them can measure what is hidden from all:
    of 20 rendered caps the lesser hidden part by the larger is 0.16 in the mean, 0.28 rms.
    """

    flat_share: float = 0.6  # a flat marker that shows less of the best camera's is tilted (53 deg) or hidden
    least_share: float = 0.8  # least part of a cap that counts as whole: its radius is a tenth smaller
    alike_share: float = 0.9  # least part of the share that another camera sees
    least_hidden: float = 0.2  # least hidden part by the largest of all cameras
    rotation_rad_s: float = 2.0  # standard deviation: a fist closes in a second
    radius_share: float = 0.1  # relative error of a profile's radii: 0.8 mm
    relief_m: float = 0.4e-3  # of a flat marker: 16 mm of colour on a curvature of 50 mm bulge by 0.6 mm
    any_m: float = 4e-3  # of a cap's seen centroid while nothing measures where the finger points
    any_rad: float = 1.0  # of the direction of a finger that shows its end, from that to the cameras
    most_tilt: float = 2.0  # largest tangent of the tilt of a sigma point, which stays on its side
    bent_rad: float = 0.75 * pi  # from the camera, of an unknown hand: it still shows a strip
    tilted: int = 7  # directions of a cap of a known hand
    any_tilted: int = 5  # and while no hand is known
    angles: int = 90  # steps of the tables
    rings: int = 16  # and `spokes`: samples of the surface
    spokes: int = 48
    tables: int = 64  # hands whose tables are kept
    corners: int = 64  # of an outline's polygon; that for a circle is 0.2 % small, which is scaled away
    rounds: int = 3  # each leaves a few per cent of the shift: the outline starts around the centroid
    cell_px: int = 8  # of a lens's table


class DepthSettings(NamedTuple):
    """Numbers of depth by disparity."""

    parallel_rad: float = radians(3.0)  # most by which cameras may be turned against each other
    alike: float = 0.05  # most by which focal lengths, and a baseline from its image rows, may differ
    law_residual: float = 0.02  # most by which the law and the cameras' places may differ where both are used
    usual_m: tuple[float, float] = (0.35, 1.0)  # depths at which they are compared without a volume
    nearest: float = 0.1  # part of a volume's greatest depth from which they are
    compared: int = 9  # depths
    tabled_m: tuple[float, ...] = (0.35, 0.45, 0.6, 0.8, 1.1)
    grid: int = 48  # cells of the table along each side of the image
    rounds: int = 3  # each leaves a thousandth of the correction off the axis


class FilterSettings(NamedTuple):
    """Numbers of the 1 € filter beside those of the rig file."""

    new_share: float = 0.25  # of a marker's noise variance in each frame: rendered 0.1; light, shape stay
    quantile: float = 9.0  # chi-square, one degree of freedom, 99.7 %: what is beyond is motion
    # Of a solved pose's noise: as a prior of the next it stays, of seven tenths a quarter shows.
    shown: float = 0.25
    memory_s: float = 0.4  # a few swings of a trembling hand


class FabrikSettings(NamedTuple):
    """Numbers of FABRIK and of the closed form that it starts from."""

    tolerance_m: float = 1e-5
    target_m: float = 1e-4  # the same, of a hand's fingers
    finger_iterations: int = 10  # from the closed form; what that cannot reach iterations improve little
    stall: float = 0.995  # of the last residual, above which an iteration gained nothing
    stalls: int = 6
    halvings: int = 14  # of the bend of a restart
    # Of least squares: steps from each start and from the best of their ends.
    first_steps: int = 8
    most_steps: int = 60
    first_damping_m2: float = 1e-7
    damping_up: float = 10.0  # by which it grows
    damping_down: float = 0.1
    reached_m: float = 1e-6
    within: float = 0.05  # of that, where a limit passed by less is rounding: clamping moves it < 0.2 um
    branch: float = 2.0 * pi  # rad by which the more bent branch is rather taken: more than any abduction
    # PIP and DIP, as shares of their ranges, from which a free pair is sought when the coupled one fails.
    starts: tuple[tuple[float, float], ...] = (
        (0.1, 0.9),
        (0.9, 0.1),
        (0.5, 0.0),
        (0.5, 1.0),
        (0.0, 0.5),
        (1.0, 0.5),
    )
    root_steps: int = 60
    grid: int = 2001  # PIPs among which branches are found
    thirds: int = 52
    fit_m: float = 3e-3  # of a finger's marker as the palm's fit has it
    held_m_s: float = 0.3  # of a hand that is held
    forget_s: float = 0.5  # after this long without markers nothing is known of the hand any more
    sweeps: int = 30  # of Jacobi


SYNC, RAYS, ASSOCIATION, CAPS = SyncSettings(), RaySettings(), AssociationSettings(), CapSettings()
DEPTH, FILTER, FABRIK = DepthSettings(), FilterSettings(), FabrikSettings()
