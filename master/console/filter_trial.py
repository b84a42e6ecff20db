"""Trial of a rig's 1 € filter on a running master, then saved to the rig's file.

It blocks, so do not call it on the page's thread.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from common.calibration import FilterCalibration, RigCalibration, load, save
from common.messages import Command, Health
from common.messages.streams import MASTER
from master.calibrate.tree_files import provenance

NAMES = ("min_cutoff_hz", "beta", "d_cutoff_hz", "jitter_m")


def saved_filter(rig_path: Path) -> FilterCalibration:
    """Return the filter settings stored in the rig's file.

    Raises:
        CalibrationError: It is missing or broken.
    """
    return load(rig_path, RigCalibration).filter


def try_filter(ask: Callable[[Command], Health], rig: str, values: Mapping[str, float]) -> None:
    """Let the master use other parameters at once; its file stays as it is.

    Raises:
        BusError: No master answers, or it refuses.
    """
    ask(Command(MASTER, "filter", json.dumps({"rig": rig, "filter": dict(values)})))


def save_filter(rig_path: Path, values: Mapping[str, float]) -> None:
    """Write the filter settings to the rig's file, with when and by what.

    A running master follows its files.

    Raises:
        CalibrationError: The file is missing, broken or read-only, or a value is out of range.
    """
    rig = load(rig_path, RigCalibration)
    new = msgspec.structs.replace(rig.filter, **values)
    made = provenance("console", (), {}, "tuned by hand")
    save(rig_path, msgspec.structs.replace(rig, filter=new, provenance=rig.provenance | {"filter": made}))
