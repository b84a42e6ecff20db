"""Numbers that tests of whole machines measure: kept as JSON, shown below the tests, held to their limits."""

import json
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path


class Measured:
    """Numbers by name; each is written at once, so that a run that is cut short has told what it knew."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._numbers: dict[str, object] = {"date": datetime.now(UTC).isoformat(timespec="seconds")}
        self.lines: list[str] = []

    def __call__(self, name: str, value: float, unit: str = "s") -> None:
        """Keep a number."""
        self._keep(name, value, unit, None)

    def at_most(self, limit: float, name: str, value: float, unit: str = "s") -> bool:
        """Keep a number; whether it is within `limit`, on a machine that has the time for it (`strain`)."""
        self._keep(name, value, unit, limit)
        return value <= limit * strain()

    def _keep(self, name: str, value: float, unit: str, limit: float | None) -> None:
        number: dict[str, object] = {"value": round(value, 3), "unit": unit, "strain": round(strain(), 1)}
        self._numbers[name] = number if limit is None else number | {"limit": limit}
        self._file.parent.mkdir(exist_ok=True)
        self._file.write_text(json.dumps(self._numbers, indent=1) + "\n")
        bound = "" if limit is None else f"  at most {limit:g}"
        overload = f"  on a machine {strain():.1f} times overloaded" if strain() > 1.0 else ""
        self.lines.append(f"{name:<66} {value:8.2f} {unit:<3}{bound}{overload}")


def kept(file: Path) -> Iterator[Measured]:
    """For a fixture: numbers that go to a file, and are shown at the end."""
    numbers = Measured(file)
    yield numbers
    print("\n" + "\n".join(numbers.lines))  # noqa: T201  # with -s


def strain() -> float:
    """How much longer things may take than on a machine that does nothing else: 1 up to two busy programs a core.

    Hosts, master and tests together make no more than that; it is above 1 where others compute beside them.
    """
    return max(1.0, os.getloadavg()[0] / (2 * (os.cpu_count() or 1)))
