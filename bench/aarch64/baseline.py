"""The recorded instructions per frame, and the gate around them."""

from pathlib import Path

import msgspec

FILE = Path(__file__).with_name("baseline.json")
GATE = (
    0.01  # counts of one program differ by 1e-3 at most between places and days: what is outside was changed
)


class BaselineError(Exception):
    """The baseline's file cannot be read."""


class Baseline(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Instructions per frame of each case, on which processor, and the versions of what was counted."""

    cpu: str
    instructions: dict[str, int]
    versions: dict[str, str]


def read(file: Path = FILE) -> Baseline | None:
    """The recorded baseline; None if there is none.

    Raises:
        BaselineError: The file is not a baseline.
    """
    if not file.exists():
        return None
    try:
        return msgspec.json.decode(file.read_bytes(), type=Baseline)
    except msgspec.MsgspecError as error:
        raise BaselineError(f"{file}: {error}; write it afresh with --record") from error


def write(baseline: Baseline, file: Path = FILE) -> None:
    """Record it."""
    file.write_bytes(msgspec.json.format(msgspec.json.encode(baseline), indent=2) + b"\n")


def within(value: float, recorded: int | None) -> bool:
    """Whether `value` is at most GATE away from what was recorded, to either side; a case not recorded is not."""
    return recorded is not None and abs(value / recorded - 1.0) <= GATE


def compared(value: float, recorded: int | None) -> str:
    """How far from the record, in words."""
    return "not recorded" if recorded is None else f"{100.0 * (value / recorded - 1.0):+.2f} % of the record"


def other_versions(new: dict[str, str], old: dict[str, str]) -> list[str]:
    """One line for each thing whose version is another than when the baseline was recorded."""
    return [
        f"{name} is {new.get(name, 'absent')}, recorded with {old.get(name, 'absent')}"
        for name in sorted(new.keys() | old.keys())
        if new.get(name) != old.get(name)
    ]
