"""Report table of a camera calibration.

A person reads it after the calibration; the same numbers are given for a machine.
"""

from collections.abc import Iterator

from master.calibrate.cameras.bundle import LENS
from master.calibrate.cameras.coverage import advice
from master.calibrate.cameras.lens_files import lens_of
from master.calibrate.cameras.result import CamerasResult, LensResult


def report_lines(result: CamerasResult) -> Iterator[str]:
    """The table, line by line."""
    for name, lens in result.lenses.items():
        yield from _lens_lines(name, lens)
    for name, pair_sd in result.baseline_sd_m.items():
        if pair_sd > 0.0:
            centre, rotation = result.place_sd[name][:3] * 1e3, result.place_sd[name][3:] * 57.2958
            yield (
                f"{name}: place known to {centre[0]:.3f} {centre[1]:.3f} {centre[2]:.3f} mm,"
                f" {rotation[0]:.4f} {rotation[1]:.4f} {rotation[2]:.4f}° (standard deviations)"
            )
    for pair in result.pairs:
        sd = result.baseline_sd_m[pair.second] if pair.first == next(iter(result.lenses)) else 0.0
        known = f" ± {1e3 * sd:.3f}" if sd > 0.0 else ""
        yield (
            f"{pair.first} - {pair.second}: {pair.views} views, baseline {1e3 * pair.baseline_m:.3f}{known} mm,"
            f" epipolar rms {pair.epipolar_rms_px:.3f} px"
        )
        yield (
            f"  squares triangulated from the written values: {pair.edge_mean_mm:.3f} ± {pair.edge_sd_mm:.3f} mm"
            f" (mean, standard deviation of {pair.edges} sides; worst off by {pair.edge_worst_mm:.2f} mm)"
        )
    what = "stereo rms" if len(result.lenses) > 1 else "rms"
    yield f"{what} {result.rms_px:.3f} px over {result.views} views"
    yield _board_line(result)
    yield "nothing was left out" if not result.rejected else f"left out ({len(result.rejected)}):"
    for no in result.rejected:
        yield f"  {no}"


def _board_line(result: CamerasResult) -> str:
    """Which board was taken, and by what it was chosen."""
    board, (along, out) = result.board, result.shape_mm
    taken = (
        f"corners {along:.2f} mm in its plane and {out:.2f} mm out of it from where they are drawn (rms)"
        if board.bent
        else "taken as drawn, flat"
    )
    if board.reason:
        return f"board: {taken}: {board.reason}"
    return (
        f"board: {taken}: in {board.views} views held out of the fit, corners are {board.flat_px:.3f} px off where a"
        f" flat board predicts them and {board.bent_px:.3f} px with a shape of its own"
        f"{'' if board.bent or board.bent_px >= board.flat_px else ', which is not certainly less'}"
    )


def _lens_lines(name: str, lens: LensResult) -> Iterator[str]:
    values = lens_of(lens.intrinsics)
    kind = "" if lens.estimated else " (held)"
    yield f"{name}: {lens.views} images, rms {lens.rms_px:.3f} px{kind}"
    yield "  " + "  ".join(
        f"{term.removesuffix('_px')} {value:.2f}" + (f" ± {sd:.2f}" if sd > 0 else "")
        for term, value, sd in zip(LENS[:4], values[:4], lens.sd[:4], strict=True)
    )
    yield "  " + "  ".join(
        f"{term} {value:.4f} ± {sd:.4f}" if sd > 0 else f"{term} {value:g}"
        for term, value, sd in zip(LENS[4:], values[4:], lens.sd[4:], strict=True)
    )
    covered = lens.covered
    yield (
        f"  seen: {100 * covered.share:.0f} % of the image, tilts to {covered.tilt_deg.max():.0f}°"
        f" ({covered.tilt_spread_deg:.0f}° apart), {covered.distance_m.min():.2f} to"
        f" {covered.distance_m.max():.2f} m"
    )
    for row in covered.cells:
        yield "    " + "".join("#" if cell else "." for cell in row)
    if wish := advice(covered):
        yield f"  it would gain most if you {wish}"


def report_json(result: CamerasResult) -> dict[str, object]:
    """The numbers; lengths in the unit of their key."""
    return {
        "rms_px": result.rms_px,
        "views": result.views,
        "cameras": {name: _lens_json(lens) for name, lens in result.lenses.items()},
        "T_first_camera": {name: [list(row) for row in place] for name, place in result.T_rig_camera.items()},
        "place_sd": {
            name: {"centre_m": sd[:3].tolist(), "rotation_rad": sd[3:].tolist()}
            for name, sd in result.place_sd.items()
        },
        "pairs": [
            {
                "cameras": [pair.first, pair.second],
                "views": pair.views,
                "baseline_m": pair.baseline_m,
                "epipolar_rms_px": pair.epipolar_rms_px,
                "edge_mean_mm": pair.edge_mean_mm,
                "edge_sd_mm": pair.edge_sd_mm,
                "edge_worst_mm": pair.edge_worst_mm,
                "edges": pair.edges,
            }
            for pair in result.pairs
        ],
        "board": _board_json(result),
        "rejected": [{"view": no.view, "camera": no.camera, "reason": no.reason} for no in result.rejected],
    }


def _board_json(result: CamerasResult) -> dict[str, object]:
    board, (along, out) = result.board, result.shape_mm
    compared: dict[str, object] = {"reason": board.reason}
    if not board.reason:
        compared = {"flat_px": board.flat_px, "bent_px": board.bent_px, "views_held_out": board.views}
    return {"bent": board.bent, "shape_rms_mm": {"in_plane": along, "out_of_plane": out}} | compared


def _lens_json(lens: LensResult) -> dict[str, object]:
    covered = lens.covered
    return {
        "views": lens.views,
        "rms_px": lens.rms_px,
        "estimated": lens.estimated,
        "values": dict(zip(LENS, lens_of(lens.intrinsics).tolist(), strict=True)),
        "sd": dict(zip(LENS, lens.sd.tolist(), strict=True)),
        "coverage": {
            "share": covered.share,
            "cells": covered.cells.astype(int).tolist(),
            "tilt_deg": covered.tilt_deg.tolist(),
            "tilt_spread_deg": covered.tilt_spread_deg,
            "distance_m": covered.distance_m.tolist(),
            "advice": advice(covered),
        },
    }
