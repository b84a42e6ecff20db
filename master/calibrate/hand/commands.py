"""`phalanx calibrate hand`: makes a hand file.

From its length alone, from the guided routine, or from a motion capture.
"""

import sys
from argparse import Namespace
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from msgspec.structs import replace

from common.calibration import HandProfile, load
from common.command_line import echo
from common.errors import CalibrationError
from common.hand.fitting import with_three_back_markers
from common.hand.model import HandModel
from common.hand.profiles import generated_profile, mirrored_profile, scaled_profile
from common.hand.routine import ROUTINE_S, STEPS
from master.calibrate.hand.measure import (
    hand_length_of,
    measure_hand,
    measured_profile,
    quick_profile,
    report_json,
    report_lines,
)
from master.calibrate.hand.observed import read_observed
from master.calibrate.hand.session import draw_hand, observe_live
from master.calibrate.report import finish
from master.calibrate.tree_files import load_marker_rig, print_lines, write_hand


def hand_command(options: Namespace) -> None:
    """Make a hand file of a length, a guided routine of 20 s, or a motion capture."""
    if options.steps:
        print_lines(step_lines())
        return
    if options.source is not None:
        _check_alone(options)
        from master.calibrate.hand.motion import hand_from_motion, motion_json, motion_lines
        from master.mocap.read import Reading, read_motion

        made = hand_from_motion(
            read_motion(options.source, Reading(options.joints, options.unit, options.side, options.rate)),
            options.name,
        )
        _finish(options, motion_lines(made), made.profile, motion_json(made))
        return
    if options.joints is not None or options.unit is not None or options.rate is not None:
        raise CalibrationError("--joints, --unit and --rate are for --from FILE")
    side = options.side or "right"
    template = template_of(options.base, side, options.name)
    _check_options(options.poses, options.live, options.length_mm, options.three_back)
    if options.poses is None and options.length_mm is not None and not options.live:
        report: dict[str, object] = {"side": side, "hand_length_mm": options.length_mm, "lengths": {}}
        scaled = quick(options.base, template, options.length_mm)
        if options.three_back:
            scaled = with_three_back_markers(scaled, options.name)
        profile = quick_profile(scaled, options.name, 1e-3 * options.length_mm)
        lines, draw = [f"{side} hand scaled to {options.length_mm:g} mm; no bone is measured"], None
    else:
        names = load_marker_rig(options.calibration, options.rig).markers
        model = HandModel.of(template)
        observed = (
            observe_live(options.bus, names, model)
            if options.poses is None
            else read_observed(options.poses, names, model)
        )
        ratio_sd = 0.03  # of one that was measured, with a goniometer or in a picture
        ratio = None if options.dip_per_pip is None else (options.dip_per_pip, ratio_sd)
        length_m = None if options.length_mm is None else 1e-3 * options.length_mm
        found = measure_hand(observed, template, length_m, ratio, _progress)
        lines, draw = report_lines(found), partial(draw_hand, measurement=found)
        data = "live" if options.poses is None else options.poses.name
        profile, report = measured_profile(found, options.name, data, options.dip_per_pip), report_json(found)
    _finish(options, lines, profile, report, draw)


def _finish(
    options: Namespace,
    lines: Iterable[str],
    profile: HandProfile,
    report: dict[str, object],
    draw: Callable[[Path], None] | None = None,
) -> None:
    finish(options, lines, report, draw, lambda out: {write_hand(out, profile): "the hand"})


def _check_alone(options: Namespace) -> None:
    """Refuse options of the other ways to make a hand."""
    given = vars(options) | {"hand": options.base}
    for name in ("poses", "live", "length_mm", "hand", "dip_per_pip", "picture"):
        if given[name] is not None and given[name] is not False:
            raise CalibrationError(f"--{name.replace('_', '-')} has no meaning with --from: leave it out")


def _check_options(poses: Path | None, live: bool, length_mm: float | None, three_back: bool) -> None:
    if live and poses is not None:
        raise CalibrationError("--poses has no meaning with --live: leave it out")
    if poses is None and not live and length_mm is None:
        raise CalibrationError(
            "give --live, --poses FILE of the routine (its steps: --steps), or --length-mm"
        )
    if three_back and (live or poses is not None):
        raise CalibrationError(
            "--three-back makes a hand from its length; to measure one, give its file with --hand"
        )


def step_lines() -> list[str]:
    """The routine for a person."""
    lines = [
        f"{ROUTINE_S:.0f} s. Lay the back of the hand on a table and leave it: palm to the cameras, tips in sight.",
        "Do one step after the other without hurry; exact times do not matter.",
    ]
    return lines + [f"{n:3}. {step.seconds:3.1f} s  {step.instruction}" for n, step in enumerate(STEPS, 1)]


def template_of(base: Path | None, side: str, name: str) -> HandProfile:
    """The hand profile that a measurement begins with.

    A file, mirrored if it is of the other hand, or the generated profile.

    Raises:
        CalibrationError: The file is missing or broken.
    """
    if base is None:
        return generated_profile(name, side)
    profile = load(base, HandProfile)
    HandModel.of(profile)
    return replace(profile if profile.side == side else mirrored_profile(profile), name=name)


def quick(base: Path | None, template: HandProfile, length_mm: float) -> HandProfile:
    """A profile of a length: the generated one, or the given one scaled.

    Raises:
        CalibrationError: No hand is that long.
    """
    try:
        generated = generated_profile(template.name, template.side, 1e-3 * length_mm)
    except ValueError as error:
        raise CalibrationError(
            f"--length-mm {length_mm:g}: {error}; measure from the wrist crease"
        ) from error
    if base is None:
        return generated
    return scaled_profile(template, 1e-3 * length_mm / hand_length_of(HandModel.of(template)))


def _progress(share: float) -> None:
    if sys.stderr.isatty():
        echo(f"\rfitting {100 * share:3.0f} % ", end="", error=True)
        if share >= 1.0:
            echo("\r\033[K", end="", error=True)
