"""`phalanx-master calibrate hand`: a hand file from its length alone, or from the guided routine."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer
from msgspec.structs import replace

from common.back_markers import with_three_back_markers
from common.calibration import HandProfile, load
from common.errors import CalibrationError
from common.hand_model import HandModel
from common.hand_profiles import generated_profile, mirrored_profile, scaled_profile
from common.hand_routine import ROUTINE_S, STEPS
from master.calibrate.hand.live import observe_live
from master.calibrate.hand.measure import hand_length_of, measure_hand
from master.calibrate.hand.observed import read_observed
from master.calibrate.hand.save import measured_profile, quick_profile, report_json, report_lines
from master.calibrate.tree_files import load_marker_rig, write_hand
from master.options import CALIB_JSON, HERE_BUS, BusEnd, Calibration, JointNames, JsonFile
from master.summary import write_summary

PosesPath = Annotated[
    Path | None, typer.Option("--poses", help="poses.npz of the routine, from `replay` or a running master.")
]
Name = Annotated[str, typer.Option(help="Name of the new hand file, without .json.")]
Side = Annotated[
    Literal["left", "right"] | None,
    typer.Option(help="Which hand; default: right, of --from as names or geometry say."),
]
Source = Annotated[
    Path | None,
    typer.Option(
        "--from", metavar="FILE", help="Motion capture of the hand's joints: .csv, .tsv, .bvh, .c3d."
    ),
]
Length = Annotated[
    Literal["m", "cm", "mm"] | None,
    typer.Option(help="Of length in --from; default: as it says, else by the size of the hand."),
]
Rate = Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Of a --from table without times.")]
LengthMm = Annotated[
    float | None,
    typer.Option(
        help="Millimetres from the wrist crease to the end of the middle finger; alone: a quick start."
    ),
]
Base = Annotated[
    Path | None, typer.Option("--hand", help="Hand file to begin with: proportions, marker places.")
]
RigName = Annotated[str, typer.Option("--rig", help="Rig whose markers the poses have.")]
DipPerPip = Annotated[
    float | None,
    typer.Option(
        min=0.0, max=2.0, help="How far the last joint bends per middle joint, where it was measured."
    ),
]
ThreeBack = Annotated[
    bool, typer.Option("--three-back", help="With three markers on the back; only with --length-mm alone.")
]
Steps = Annotated[bool, typer.Option("--steps", help="Only tell the steps of the routine.")]
Live = Annotated[bool, typer.Option("--live", help="Do the routine now, before the running master.")]
Out = Annotated[Path | None, typer.Option(help="Tree to write hands/NAME.json into.")]
Picture = Annotated[Path | None, typer.Option(help="Write a picture of lengths and residuals to this .png.")]

_RATIO_SD = 0.03  # of one that was measured, with a goniometer or in a picture


def hand_command(
    poses: PosesPath = None,
    name: Name = "me",
    side: Side = None,
    length_mm: LengthMm = None,
    base: Base = None,
    rig: RigName = "desk",
    calibration: Calibration = CALIB_JSON,
    dip_per_pip: DipPerPip = None,
    out: Out = None,
    json_file: JsonFile = None,
    picture: Picture = None,
    three_back: ThreeBack = False,
    steps: Steps = False,
    live: Live = False,
    bus: BusEnd = HERE_BUS,
    source: Source = None,
    joints: JointNames = None,
    unit: Length = None,
    rate: Rate = None,
) -> None:
    """Make a hand file: from the hand's length, measured by a guided routine of 20 s, or from motion capture.

    Examples:

      phalanx-master calibrate hand --length-mm 190 --side right --name me --out calib_json      a quick start

      phalanx-master calibrate hand --steps                                                      what to do for:

      phalanx-master calibrate hand --poses poses.npz --side right --name me --out calib_json

      phalanx-master calibrate hand --live --side right --name me --out calib_json               step by step

      phalanx-master calibrate hand --from me.bvh --side right --name me --out calib_json        joints of others
    """
    if steps:
        for line in step_lines():
            typer.echo(line)
        return
    if source is not None:
        _check_alone(
            poses=poses, live=live, length_mm=length_mm, hand=base, dip_per_pip=dip_per_pip, picture=picture
        )
        from master.calibrate.hand.motion import hand_from_motion, motion_json, motion_lines
        from master.mocap.read import Reading, read_motion

        made = hand_from_motion(read_motion(source, Reading(joints, unit, side, rate)), name)
        for line in motion_lines(made):
            typer.echo(line)
        _finish(out, made.profile, motion_json(made), json_file)
        return
    if joints is not None or unit is not None or rate is not None:
        raise CalibrationError("--joints, --unit and --rate are for --from FILE")
    side = side or "right"
    template = template_of(base, side, name)
    _check_together(poses, live, length_mm, three_back)
    if poses is None and length_mm is not None and not live:
        report: dict[str, object] = {"side": side, "hand_length_mm": length_mm, "lengths": {}}
        scaled = quick(base, template, length_mm)
        if three_back:
            scaled = with_three_back_markers(scaled, name)
        profile = quick_profile(scaled, name, 1e-3 * length_mm)
        typer.echo(f"{side} hand scaled to {length_mm:g} mm; no bone is measured")
    else:
        names = load_marker_rig(calibration, rig).markers
        model = HandModel.of(template)
        observed = observe_live(bus, names, model) if poses is None else read_observed(poses, names, model)
        ratio = None if dip_per_pip is None else (dip_per_pip, _RATIO_SD)
        length_m = None if length_mm is None else 1e-3 * length_mm
        found = measure_hand(observed, template, length_m, ratio, _progress)
        for line in report_lines(found):
            typer.echo(line)
        data = "live" if poses is None else poses.name
        profile, report = measured_profile(found, name, data, dip_per_pip), report_json(found)
        if picture is not None:
            from master.calibrate.hand.picture import draw_hand

            draw_hand(picture, found)
    _finish(out, profile, report, json_file)


def _finish(
    out: Path | None, profile: HandProfile, report: dict[str, object], json_file: Path | None
) -> None:
    written = None if out is None else write_hand(out, profile)
    typer.echo("nothing written: give --out DIR" if written is None else f"wrote {written}")
    if json_file is not None:
        write_summary(json_file, report | {"written": None if written is None else str(written)})


def _check_alone(**others: object) -> None:
    """Refuse options of the other ways to make a hand."""
    for name, value in others.items():
        if value is not None and value is not False:
            raise CalibrationError(f"--{name.replace('_', '-')} has no meaning with --from: leave it out")


def _check_together(poses: Path | None, live: bool, length_mm: float | None, three_back: bool) -> None:
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
    """What a measurement begins with: a file, mirrored if it is of the other hand, or the generated profile.

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
        typer.echo(f"\rfitting {100 * share:3.0f} % ", nl=False, err=True)
        if share >= 1.0:
            typer.echo("\r\033[K", nl=False, err=True)
