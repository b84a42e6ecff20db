"""Types of command-line options: numbers with bounds, and ports.

Their errors name the value and what is expected.
"""

import math
from argparse import ArgumentTypeError
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Number:
    """A finite number, or a whole one, between two bounds.

    Attributes:
        low, high: Bounds; None: there is none.
        whole: Whether it has to be an integer.
    """

    low: float | None = None
    high: float | None = None
    whole: bool = False

    def __call__(self, text: str) -> float | int:
        """Read it.

        Raises:
            ArgumentTypeError: It is no such number.
        """
        try:
            value = int(text) if self.whole else float(text)
        except ValueError as error:  # argparse would print the name of the class
            kind = "a whole number" if self.whole else "a number"
            raise ArgumentTypeError(f"{text}: must be {kind}") from error
        if not math.isfinite(value):
            raise ArgumentTypeError(f"{text}: must be a finite number")
        if self.low is not None and value < self.low:
            raise ArgumentTypeError(f"{text}: must be at least {self.low:g}")
        if self.high is not None and value > self.high:
            raise ArgumentTypeError(f"{text}: must be at most {self.high:g}")
        return value


def number(low: float | None = None, high: float | None = None) -> Number:
    """A finite number between these bounds."""
    return Number(low, high)


def whole(low: int | None = None, high: int | None = None) -> Number:
    """A whole number between these bounds."""
    return Number(low, high, whole=True)


def positive(text: str) -> float:
    """A number above 0.

    Raises:
        ArgumentTypeError: It is none.
    """
    value = Number()(text)
    if not value > 0.0:
        raise ArgumentTypeError(f"{text}: must be positive")
    return value


def megabytes(text: str) -> float:
    """A number from 0 on.

    Raises:
        ArgumentTypeError: It is none.
    """
    value = Number()(text)
    if value < 0.0:
        raise ArgumentTypeError(f"{text}: must not be negative")
    return value


def count(text: str) -> int:
    """A whole number from 1 on.

    Raises:
        ArgumentTypeError: It is none.
    """
    if not text.isdecimal() or int(text) < 1:
        raise ArgumentTypeError(f"{text}: must be a whole number, at least 1")
    return int(text)


def port(text: str) -> int:
    """A port of UDP or TCP.

    Raises:
        ArgumentTypeError: It is none.
    """
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise ArgumentTypeError(f"{text}: must be a port, 1 to 65535")
    return int(text)
