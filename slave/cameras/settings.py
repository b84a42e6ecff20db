"""Compare the settings of a camera with what was asked for.

A camera rounds: exposure to whole rows, gain to whole register codes. So every setting carries how far the value read
back may be from the value wanted, and why. Whatever is further off is an error that names setting, wanted, got and
what to do. What changes settings of a running camera watches its frames go by (`FrameObserver`), without holding them
up.
"""

import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from common.calibration import CameraCalibration
from common.errors import CameraError


@dataclass(frozen=True, slots=True)
class Setting:
    """One quantity that the camera must have."""

    name: str  # as the camera calls it
    wanted: tuple[float, ...]  # values, one or several (a pair of colour gains)
    tolerance: float  # largest allowed distance of each value, in its unit
    unit: str  # for the text of errors; may be empty
    source: str  # where the wanted value comes from, for the text of errors


def as_values(value: object) -> tuple[float, ...] | None:
    """Numbers of a scalar or a sequence; None where it holds anything else."""
    items: Sequence[object] = list(value) if isinstance(value, (list, tuple)) else [value]  # pyright: ignore[reportUnknownArgumentType]
    numbers = [float(item) for item in items if isinstance(item, (int, float))]
    return tuple(numbers) if len(numbers) == len(items) else None


def differences(wanted: Iterable[Setting], got: Mapping[str, object]) -> list[str]:
    """What is not as wanted, or was not read back, one sentence each."""
    found: list[str] = []
    for setting in wanted:
        unit = setting.unit
        start = f"{setting.name}: wanted {_text_of(setting.wanted, unit)}"
        if setting.name not in got:
            found.append(f"{start}, not read back at all")
            continue
        values = as_values(got[setting.name])
        near = (
            values is not None
            and len(values) == len(setting.wanted)
            and all(abs(a - b) <= setting.tolerance for a, b in zip(values, setting.wanted, strict=True))
        )
        if not near:
            text = got[setting.name] if values is None else _text_of(values, unit)
            allowed = _text_of((setting.tolerance,), unit)
            found.append(f"{start} ({setting.source}), got {text}, allowed are {allowed} off")
    return found


def demand(where: str, wanted: Iterable[Setting], got: Mapping[str, object], fix: str) -> None:
    """Raise unless the camera has everything."""
    found = differences(wanted, got)
    if found:
        raise CameraError(f"{where} did not take its settings: {'; '.join(found)}. {fix}")


def how_far(
    size: tuple[int, int], rate_hz: float, offered: tuple[int, int], rates_hz: Sequence[float]
) -> tuple[float, float]:
    """Distance of an offer from what is wanted: by size [px], then by rate [Hz]."""
    sides = sum(abs(math.log(a / b)) for a, b in zip(size, offered, strict=True))
    return sides, min((abs(math.log(one / rate_hz)) for one in rates_hz), default=0.0)


def change(
    apply: Callable[[CameraCalibration], None], old: CameraCalibration, new: CameraCalibration
) -> None:
    """Have `new` applied; if that fails, `old`, and see that it came back.

    `apply` writes the settings of a camera file, reads them back and raises `CameraError` at a difference.

    Raises:
        CameraError: `new` was not taken; the text states so, and what became of `old`.
    """
    try:
        apply(new)
    except CameraError as error:
        try:
            apply(old)
        except CameraError as second:
            raise CameraError(f"{error}; and the settings before did not come back: {second}") from second
        raise CameraError(f"{error}; the settings before are back") from error


def _text_of(values: Sequence[float], unit: str) -> str:
    return ", ".join(f"{value:.6g}" for value in values) + (f" {unit}" if unit else "")


T = TypeVar("T")


class FrameObserver(Generic[T]):
    """Holds the newest of what went by, and how many there were."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: T | None = None
        self._count = 0

    @property
    def newest(self) -> T | None:
        """What went by last, if anything."""
        return self._newest

    def put(self, item: T) -> None:
        """The loop has read `item`. Never waits longer than a look at it takes."""
        with self._changed:
            self._newest = item
            self._count += 1
            self._changed.notify_all()

    def following(self, count: int, timeout_s: float) -> Iterator[T]:
        """Wait for `count` further items; `CameraError`: none came for `timeout_s` [s]."""
        return self._after(self._count, count, timeout_s)

    def _after(self, last: int, count: int, timeout_s: float) -> Iterator[T]:
        for _ in range(count):
            with self._changed:
                if not self._changed.wait_for(lambda seen=last: self._count > seen, timeout_s):
                    raise CameraError(
                        f"no frame was read for {timeout_s:g} s: the camera is away, or the slave waits for a master"
                    )
                last, item = self._count, self._newest
            assert item is not None  # it was counted
            yield item
