"""Frozen recordings: messages as slaves send them, with files of calibration, and the exact truth beside them."""

import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.oracle.truth import FROZEN, Truth
from common.messages import ImuSample, MarkerDetections, WristDetections
from common.recording.messages import MessageWriter


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """One recording of a set.

    Attributes:
        name: Of the recording in its set.
        rigs: The rig that is solved, or those of one hand.
        files: Files of calibration, by their path in a calibration tree.
        messages: In the order in which they are solved.
        truth: Exact.
    """

    name: str
    rigs: tuple[str, ...]
    files: dict[str, bytes]
    messages: Sequence[MarkerDetections | WristDetections | ImuSample]
    truth: Truth


def calibration_files(tree: Path, rig: str) -> dict[str, bytes]:
    """The files of one rig of a calibration tree, by their path in it."""
    names = [f"rigs/{rig}.json"]
    about = json.loads((tree / names[0]).read_text())
    names += [f"cameras/{camera}.json" for camera in about["cameras"]]
    names.append(f"hands/{about['hand']}.json")
    return {name: (tree / name).read_bytes() for name in names}


def freeze(out: Path, set_name: str, pieces: Iterable[Piece]) -> None:
    """Write recordings and truths of one set; what it had before goes.

    Raises:
        RecordingError: A recording cannot be written.
        OSError: A folder or a truth cannot.
    """
    folder = out / FROZEN / set_name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for piece in pieces:
        about = {"rigs": json.dumps(piece.rigs), "continuous": json.dumps(piece.truth.continuous)}
        writer = MessageWriter(folder / f"{piece.name}.mcap", piece.files, about)
        for message in piece.messages:
            writer.write("taken", message, getattr(message, "ready_t_ns", message.t_ns))
        writer.close()
        piece.truth.save(folder / f"{piece.name}.npz")
        print(f"{set_name}/{piece.name}: {len(piece.messages)} messages", flush=True)
