"""How far a marker walks through the code until it is a pose: the files and functions of a traced replay."""

import sys
from collections import Counter
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any

from master.rig.pipeline import pipeline_of
from master.run.dispatcher import Dispatcher
from tests.synthetic_run import synthetic_run

ROOMS = "master", "common"
ROOT = Path(__file__).resolve().parents[1]
# A hand goes another way in its first epochs, and where a marker comes or goes.
SETTLED, POSES = 10, 20
MOST_FILES, MOST_FUNCTIONS = 22, 64


def nothing(name: str) -> AbstractContextManager[None]:
    """A stage that nobody measures."""
    return nullcontext()


def test_a_marker_becomes_a_pose_by_few_files_and_functions() -> None:
    """Kernels are counted as well; what a kernel calls is part of it."""
    run = synthetic_run(SETTLED + POSES)
    dispatcher = Dispatcher([run.setup], [pipeline_of(run.setup, nothing)], nothing, gestures=False)
    walked: Counter[tuple[str, str]] = Counter()

    def note(frame: FrameType, event: str, what: Any) -> None:
        file = Path(frame.f_code.co_filename)
        if event == "call" and ROOT in file.parents and file.relative_to(ROOT).parts[0] in ROOMS:
            walked[str(file.relative_to(ROOT)), frame.f_code.co_qualname] += 1
        elif event == "c_call" and str(what.__module__).partition(".")[0] in ROOMS:  # a kernel
            walked[what.__module__.replace(".", "/") + ".py", what.__name__] += 1

    poses = 0
    try:
        for message in run.messages:
            if poses == SETTLED:
                sys.setprofile(note)
            poses += sum(1 for _ in dispatcher.push(message))
    finally:
        sys.setprofile(None)
    files = {file for file, _ in walked}
    listed = "\n".join(f"{file} {name} {count}" for (file, name), count in sorted(walked.items()))
    assert poses > SETTLED + 0.8 * POSES
    assert len(files) <= MOST_FILES, listed
    assert len(walked) <= MOST_FUNCTIONS, listed
