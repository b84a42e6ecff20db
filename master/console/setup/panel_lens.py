"""Panel of step 4: lenses and places of the cameras.

They are measured from a printed board that is shown to the cameras.
"""

import json
from pathlib import Path
from typing import cast

from nicegui import ui

from master.console.setup.commands import Value
from master.console.setup.job import Job
from master.console.setup.parts import Desk, heading, job_view, previews
from master.console.setup.session import LENS
from master.console.setup.wizards import WIZARDS


def build(desk: Desk) -> None:
    """Fill the panel."""
    heading(
        "Lenses and places",
        "Hold a printed board still before all cameras, then somewhere else, near and far, tilted every way.",
    )
    with ui.expansion("Print a board", icon="print").classes("w-full"):
        _print(desk)
    with ui.row().classes("items-end"):
        board = ui.input("Board: inner corners, columns x rows", value="9x6").classes("w-72")
        square = ui.number("Side of a square in mm, as measured on the print", value=25.0, min=2.0, max=500.0)
        square.classes("w-80")
        views = ui.number("Views to take", value=20, min=5, max=200, step=1, format="%d").classes("w-40")

    async def start() -> None:
        values: dict[str, Value] = {"board": board.value, "square_mm": square.value, "views": views.value}
        await desk.attempt(lambda: desk.session.start_lens(values))

    with ui.row():
        ui.button("Start taking views", on_click=start).props('icon="photo_camera"')
        ui.button("Next: colours", on_click=lambda: desk.go("colours")).props("flat")
    job_view(desk, lambda: desk.session.jobs.get(LENS), lambda: desk.go("colours"), words=verdict, early=True)
    previews(desk)


def _print(desk: Desk) -> None:
    paper = ui.select(["A4", "A3", "A2", "letter"], label="Paper", value="A4").classes("w-40")

    async def draw() -> None:
        await desk.attempt(lambda: desk.session.start(WIZARDS["board"], {"paper": paper.value}))

    ui.label("Print it at 100 %, measure the ruler (100 mm), glue it on something flat and stiff.").classes(
        "setup-text"
    )
    ui.button("Make the page", on_click=draw).props('icon="grid_on"')
    job_view(desk, lambda: desk.session.jobs.get("board"), lambda: None)


def verdict(job: Job) -> str:
    """What the residuals of the fit mean, and whether to do it again."""
    path = job.work / "result.json"
    return judged(_read(path)) if path.exists() else ""


def judged(numbers: dict[str, object]) -> str:
    """The same of the figures of `calibrate cameras stereo --json`."""
    rms = float(cast(float, numbers["rms_px"]))
    pairs = cast(list[dict[str, float]], numbers["pairs"])
    off = [abs(pair["edge_sd_mm"]) / max(abs(pair["edge_mean_mm"]), 1e-9) for pair in pairs]
    poor = [name for name, lens in _lenses(numbers).items() if lens]
    text = f"Corners fit to {rms:.2f} px; squares come out alike to {100 * max(off, default=0.0):.1f} %. "
    good_px, poor_px = 0.6, 1.2  # of all corners, root mean square
    squares_share = 0.01
    if rms > poor_px or max(off, default=0.0) > 5 * squares_share:
        return (
            text + "Repeat it: the board moved, is not flat, or its squares are of another size than stated."
        )
    if rms > good_px or max(off, default=0.0) > 2 * squares_share:
        return text + "Fair: usable; more views, held stiller, would make it better."
    more = f" It would gain most by more views for {', '.join(poor)}: in corners and tilted." if poor else ""
    return text + "Good: use it." + more


def _lenses(numbers: dict[str, object]) -> dict[str, str]:
    """Camera -> what would help it most."""
    cameras = cast(dict[str, dict[str, dict[str, str]]], numbers["cameras"])
    return {name: lens["coverage"]["advice"] for name, lens in cameras.items()}


def _read(path: Path) -> dict[str, object]:
    return cast(dict[str, object], json.loads(path.read_text()))
