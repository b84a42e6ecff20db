"""A measurement finds a hand's lengths, and writes them into its file.

Markers of a routine enter, a profile with every measured length leaves; the others are scaled, and named so.
A length counts as measured when it is within 1 mm with 99 % certainty, and by the markers, not by the priors.
With caps on the tips alone the length of a finger is found, and often not its division: then the sum is
measured, and its parts stay in the proportion of the template.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.calibration import HandProfile, Provenance, RestJoint
from common.errors import FitError
from common.hand.model import CHAINS, FINGERS, JOINTS, TIPS, WRIST, HandModel, couplings_of
from common.hand.profiles import mirrored_profile, scaled_profile
from master.calibrate.hand.observed import GRID_S, Alignment, Observed, align, flat_scale, missing_steps
from master.calibrate.hand.problem import HandRoutineProblem, Knots, ShapeFit, fit_shape
from master.calibrate.hand.shape import PER_FINGER, Priors, RoutineTargets, Shape
from master.calibrate.tree_files import provenance, vector_of

WITHIN_M = 1e-3
CERTAIN = 2.576  # standard deviations of 99 %
BONES = ("proximal", "middle", "distal")
THUMB_BONES = ("metacarpal", "proximal", "distal")
_GROUPS = ((0,), (1,), (2,), (1, 2), (0, 1), (0, 1, 2))


@dataclass(frozen=True, slots=True)
class Length:
    """One length of the hand: a bone, or neighbouring bones together."""

    finger: int  # index, 0 thumb ... 4 little
    bones: tuple[int, ...]  # which of its three links
    length_m: float
    scaled_m: float  # as the template, scaled to this hand, has it
    sigma_m: float  # this and before_m: posterior and prior standard deviation
    before_m: float

    @property
    def measured(self) -> bool:
        """True if the markers determine the length."""
        prior_share = 0.5  # of the sd before: more comes from the priors
        return CERTAIN * self.sigma_m <= WITHIN_M and self.sigma_m <= prior_share * self.before_m

    @property
    def name(self) -> str:
        """Such as `index middle + distal`."""
        parts = THUMB_BONES if self.finger == 0 else BONES
        return f"{FINGERS[self.finger]} {' + '.join(parts[bone] for bone in self.bones)}"


@dataclass(frozen=True, slots=True, eq=False)
class HandMeasurement:
    """Measurement of a hand by a routine."""

    observed: Observed
    alignment: Alignment
    template: HandModel  # the hand it began with, scaled
    fit: ShapeFit
    lengths: tuple[Length, ...]  # every bone, and the sums of neighbours

    @property
    def rms_m(self) -> float:
        """Root mean square of the markers' residuals, per axis."""
        return float(np.sqrt(np.nanmean(self.fit.residual_m**2)))

    def parted(self, finger: int) -> tuple[Length, ...]:
        """Measured lengths of a finger without overlap, as finely divided as measured."""
        found: list[Length] = []
        for length in (length for length in self.lengths if length.finger == finger and length.measured):
            if not any(set(length.bones) & set(other.bones) for other in found):
                found.append(length)
        return tuple(found)


def measure_hand(
    observed: Observed,
    template: HandProfile,
    hand_length_m: float | None = None,
    dip_per_pip: tuple[float, float] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> HandMeasurement:
    """Fit a hand to a routine.

    Args:
        template: Proportions to begin with, and where the markers sit; its size does not matter.
        hand_length_m: Length of the hand, if it was measured; None: from the flat hand's markers.
        dip_per_pip: Mean and standard deviation of the DIP's ratio, if it was measured.
        progress: Called with the share that is done.

    Raises:
        FitError: A step is missing, the palm moved, it is the other hand, or none; with what to do.
    """
    model = _scaled(observed, template, hand_length_m)
    alignment = align(observed, model)
    _check_side(observed, template, alignment)
    if gaps := missing_steps(observed, alignment, model):
        raise FitError(
            "the routine is not complete: " + "; ".join(gaps[:6]) + ". Do these steps again, in full"
        )
    progress(0.1)
    priors = Priors() if dip_per_pip is None else Priors(dip_ratio=dip_per_pip)
    problem = problem_of(observed, model, alignment, priors)
    fit = fit_shape(problem, lambda share: progress(0.1 + 0.9 * share))
    if not problem.palm_free:
        _check_palm(problem, fit)
    return HandMeasurement(observed, alignment, model, fit, lengths_of(problem, fit))


def problem_of(
    observed: Observed, model: HandModel, alignment: Alignment, priors: Priors
) -> HandRoutineProblem:
    """The least-squares problem of an aligned routine."""
    knots = Knots.over(observed.t_s, GRID_S)
    names = observed.names
    seen_back = np.isfinite(observed.points_m[:, 5:, 0]).sum(axis=1)
    free_with = 3  # markers on the back that measure the palm's pose
    return HandRoutineProblem(
        model=model,
        cap_m=np.array([model.mount(name).offset_m for name in names[:5]]),
        prior=Shape.of(model, names[5:], priors.dip_ratio[0], priors.thumb_ratio[0]),
        points_m=observed.points_m,
        whiten=whitening(observed.cov_m2, priors.model_m),
        knots=knots,
        targets=RoutineTargets.of(alignment.at(knots.time_s)),
        start=alignment.T_rig_palm,
        palm_free=bool(np.quantile(seen_back, 0.1) >= free_with),
        priors=priors,
    )


def whitening(cov_m2: Float, model_m: float) -> Float:
    """Inverse square roots (..., 3, 3) of covariances plus the model's error; 0: NaN."""
    known = np.asarray(np.isfinite(cov_m2).all(axis=(-2, -1)), np.bool_)
    filled = np.where(known[..., None, None], cov_m2, np.eye(3)) + model_m**2 * np.eye(3)
    value, vector = np.linalg.eigh(filled)
    root = (vector / np.sqrt(value)[..., None, :]) @ np.swapaxes(vector, -1, -2)
    return root * known[..., None, None]


def lengths_of(problem: HandRoutineProblem, fit: ShapeFit) -> tuple[Length, ...]:
    """Every bone, then sums, with the uncertainty of each."""
    before = problem.shape_sd()
    out: list[Length] = []
    for finger in range(5):
        at = PER_FINGER * finger
        cov, prior = fit.cov[at : at + 3, at : at + 3], before[at : at + 3]
        for bones in _GROUPS:
            pick: Bool = np.isin(np.arange(3), bones)
            fitted, scaled = (float(one.length_m[finger, pick].sum()) for one in (fit.shape, problem.prior))
            sigma, sd = float(np.sqrt(pick @ cov @ pick)), float(np.sqrt((prior[pick] ** 2).sum()))
            out.append(Length(finger, bones, fitted, scaled, sigma, sd))
    return tuple(out)


def _scaled(observed: Observed, template: HandProfile, hand_length_m: float | None) -> HandModel:
    model = HandModel.of(template)
    own = hand_length_of(model)
    length = own * flat_scale(observed, model) if hand_length_m is None else hand_length_m
    shortest_m, longest_m = 0.1, 0.25
    if not shortest_m <= length <= longest_m:
        raise FitError(
            f"the flat hand would be {1e3 * length:.0f} mm long: these are not the five tips of a hand; check the"
            " markers' colours and the rig's calibration"
        )
    return HandModel.of(scaled_profile(template, length / own))


def hand_length_of(model: HandModel) -> float:
    """Wrist crease to the end of the middle finger [m]."""
    tip = TIPS[2]
    whole = np.linalg.norm(model.rest_position_m[tip] - model.rest_position_m[WRIST]) + model.radius_m[tip]
    return float(whole) / 1.0246  # the wrist joint of generated profiles lies behind the crease


def _check_side(observed: Observed, template: HandProfile, alignment: Alignment) -> None:
    mirrored = _scaled(observed, mirrored_profile(template), None)
    other = align(observed, mirrored).cost_m
    other_side = 0.6  # the mirrored hand fits with this share of the distance: it is the other one
    if other < other_side * alignment.cost_m:
        raise FitError(
            f"this is a {mirrored.profile.side} hand: mirrored, the routine fits to {1e3 * other:.0f} mm, as a"
            f" {template.side} one to {1e3 * alignment.cost_m:.0f} mm; give --side {mirrored.profile.side}"
        )
    if alignment.cost_m > 0.025:
        raise FitError(
            f"the markers are {1e3 * alignment.cost_m:.0f} mm off the routine (rms): the palm did not rest, or"
            " the steps were others; lay the hand down and follow the steps"
        )


def _check_palm(problem: HandRoutineProblem, fit: ShapeFit) -> None:
    """Refuse a palm that moved far more than its prior expects."""
    priors, step_s = problem.priors, np.sqrt(problem.knots.spacing_s)
    expected_rms = np.repeat([priors.palm_rad_s, priors.palm_m_s], 3) * step_s
    wander = np.sqrt((np.diff(fit.palm, axis=0) ** 2).mean(axis=0)) / expected_rms
    if wander.max() > 1.2:  # times the wandering that is assumed of a palm that rests
        rotation, shift = (float(np.ptp(part, axis=0).max()) for part in (fit.palm[:, :3], fit.palm[:, 3:]))
        raise FitError(
            f"the palm did not rest: it moved by {1e3 * shift:.0f} mm and turned by {np.degrees(rotation):.0f} degrees;"
            " lay"
            " the back of the hand on a table, or paint three markers on it and show them"
        )


TOOL = "calibrate hand"
_QUICK = "rest_joints"  # marks a whole hand that is only scaled


def measured_profile(
    measurement: HandMeasurement, name: str, data: str, dip_per_pip: float | None = None
) -> HandProfile:
    """The template with every measured length inserted, from data of the given name.

    The parts of a measured sum keep the template's proportions. `dip_per_pip` is the DIP's measured ratio;
    None: the template's.
    """
    model = measurement.template
    factor = bone_factors(measurement)
    profile = replace(model.profile, name=name, rest_joints=stretched(model, factor))
    how: dict[str, Provenance] = {}
    for finger, label in enumerate(FINGERS):
        found = measurement.parted(finger)
        own_bones = {bone for length in found for bone in length.bones}
        residual = {f"{_key(length.name)}_sigma_mm": round(1e3 * length.sigma_m, 3) for length in found}
        residual["rms_mm"] = round(1e3 * measurement.rms_m, 3)
        shared = [length.name for length in found if len(length.bones) > 1]
        scaled = [
            part.name
            for part in measurement.lengths
            if part.finger == finger and len(part.bones) == 1 and part.bones[0] not in own_bones
        ]
        note = [f"measured together, divided as in the template: {', '.join(shared)}"] if shared else []
        note += [f"not measured, scaled from the hand length: {', '.join(scaled)}"] if scaled else []
        note.append("the distal bone ends where the cap's offset puts the tip joint")
        how[label] = provenance(TOOL, (data,), residual, "; ".join(note))
    if dip_per_pip is not None:
        profile = replace(profile, couplings=replace(couplings_of(profile), dip_per_pip=dip_per_pip))
    before = {part: one for part, one in profile.provenance.items() if part != _QUICK}
    return replace(profile, provenance=before | how)


def bone_factors(measurement: HandMeasurement) -> Float:
    """Stretch factors (5, 3) of the template's bones; 1 where nothing was measured."""
    factor = np.ones((5, 3))
    for finger in range(5):
        for length in measurement.parted(finger):
            factor[finger, list(length.bones)] = length.length_m / length.scaled_m
    return factor


def stretched(model: HandModel, factor: Float) -> dict[str, RestJoint]:
    """Rest joints with the chains' bones stretched by (5, 3); roots are kept."""
    rest = dict(model.profile.rest_joints)
    for chain, own in zip(CHAINS, factor, strict=True):
        at = model.rest_position_m[chain[0]]
        for (a, b), share in zip(pairwise(chain), own, strict=True):
            at = at + share * (model.rest_position_m[b] - model.rest_position_m[a])
            rest[JOINTS[b]] = replace(rest[JOINTS[b]], position_m=vector_of(at))
    return rest


def quick_profile(profile: HandProfile, name: str, length_m: float) -> HandProfile:
    """A profile scaled from the length of the hand alone, with a note of it."""
    note = f"scaled from a hand length of {1e3 * length_m:.0f} mm: no bone is measured, individuals differ by 5 to 8 %"
    return replace(profile, name=name, provenance={_QUICK: provenance(TOOL, ("hand length",), {}, note)})


def report_lines(measurement: HandMeasurement) -> list[str]:
    """The table for a person."""
    template = measurement.template
    rms, times = 1e3 * measurement.rms_m, measurement.fit.spread
    lines = [
        f"{template.profile.side} hand, about {1e3 * hand_length_of(template):.0f} mm long",
        f"residuals {rms:.2f} mm rms per axis, {times:.2f} times what the markers' covariances expect",
        f"{'bone':34} {'fitted':>8} {'+- 99 %':>8} {'scaled':>8}",
    ]
    for finger in range(5):
        parted = measurement.parted(finger)
        own_bones: set[int] = {bone for length in parted for bone in length.bones}
        for length in measurement.lengths:
            if length.finger != finger or (len(length.bones) > 1 and length not in parted):
                continue
            if length in parted:
                verdict = "measured"
            elif set(length.bones) <= own_bones:
                verdict = "undetermined alone: part of a measured sum"
            else:
                verdict = "undetermined: keeps the scaled value"
            lines.append(
                f"{length.name:34} {1e3 * length.length_m:8.1f} {1e3 * CERTAIN * length.sigma_m:8.1f}"
                f" {1e3 * length.scaled_m:8.1f}  {verdict}"
            )
    return lines


def report_json(measurement: HandMeasurement) -> dict[str, object]:
    """The same for programs [mm]."""
    return {
        "side": measurement.template.profile.side,
        "hand_length_mm": round(1e3 * hand_length_of(measurement.template), 2),
        "rms_mm": round(1e3 * measurement.rms_m, 4),
        "spread": round(measurement.fit.spread, 4),
        "align_mm": round(1e3 * measurement.alignment.cost_m, 2),
        "lengths": {
            _key(length.name): {
                "mm": round(1e3 * length.length_m, 3),
                "sigma_mm": round(1e3 * length.sigma_m, 3),
                "scaled_mm": round(1e3 * length.scaled_m, 3),
                "measured": length.measured,
            }
            for length in measurement.lengths
        },
    }


def _key(name: str) -> str:
    return name.replace(" + ", "_").replace(" ", "_")
