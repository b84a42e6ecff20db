"""Writes what was measured of the scale into its pages: docs/scale.html computes with it, docs/scale.md shows it."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import cast

_DATA = re.compile(r'(<script type="application/json" id="measured">\n).*?(\n</script>)', re.DOTALL)
_TABLE = re.compile(r"(<!-- measured -->\n).*?(\n<!-- end -->)", re.DOTALL)
_HEAD = (
    "| | cameras | cores | a camera | without the hand | poses/s | left out | messages | lost | p50 ms | p99 ms"
    " | load |\n"
    "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
)
Found = Mapping[str, Mapping[str, object]]


def into_page(page: Path, found: Found) -> None:
    """Write it into the page, and into the text of the same name beside it, in place of what they have.

    Raises:
        ValueError: One of them has no place for it.
    """
    _replace(page, _DATA, json.dumps(found, indent=1))
    text = page.with_suffix(".md")
    if text.exists():
        _replace(text, _TABLE, tables(found))


def tables(found: Found) -> str:
    """The runs as a table for a person, and what the line through them says."""
    model = found["model"]
    rows = [_row(cast(Mapping[str, float], run)) for run in found["runs"].values()]
    lines: list[str] = []
    if "pose_ms" in model:
        lines.append(
            f"A master takes {model['pose_ms']} ms of processor for each pose and {model['message_ms']} ms for each"
            " message of a camera: the straight line through the runs of a room, from which none is off by more than"
            f" {model['off_line_percent']} %."
        )
    if "hop_p50_ms" in model:
        lines.append(
            f"Each hop of a relay or router adds {model['hop_p50_ms']} ms, 99 % below {model['hop_p99_ms']} ms."
        )
    return "\n".join([_HEAD, *rows, "", " ".join(lines)])


def _row(run: Mapping[str, float]) -> str:
    gone = run["lost"] + run["dropped"] + run["blocked"]
    return (
        f"| {run['layout']}, {run['rate_hz']:g} Hz | {run['cameras']} | {run['cores']:.2f} |"
        f" {run['cores'] / run['cameras']:.3f} | {run['without_hand']:.3f} | {run['poses_hz']:.1f}"
        f" | {run['dropped_epochs']} |"
        f" {run['sent']} | {gone} | {run['latency_p50_ms']:.1f} | {run['latency_p99_ms']:.1f} | {run['load']:.0f} |"
    )


def _replace(file: Path, place: re.Pattern[str], new: str) -> None:
    text, places = place.subn(lambda found: found[1] + new + found[2], file.read_text())
    if places != 1:
        raise ValueError(f"{file}: expected one place for what was measured, found {places}")
    file.write_text(text)
