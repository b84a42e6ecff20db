"""Form fields of a calibration, read from the command's own options.

Thus page and command line cannot differ.
"""

from argparse import SUPPRESS, Action, ArgumentParser
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from common.command_line import Command
from common.errors import CalibrationError
from common.option_types import Number

Shape = Literal["text", "number", "whole", "flag", "choice", "path", "list"]
Value = str | float | bool | None
_UNITS = {"_m_s": "m/s", "_mm": "mm", "_px": "px", "_ms": "ms", "_deg": "°"}


@dataclass(frozen=True, slots=True)
class Field:
    """One option or argument of a command.

    Attributes:
        name: Its name among the options that are read.
        flag: On the command line, such as --square-mm; empty for an argument.
        label: For a person.
        help: What it means.
        shape: How it is entered.
        default: What it is if nothing is entered; None: left out.
        required: Whether the command needs it.
        choices: Of a choice.
        low, high: Bounds of a number.
    """

    name: str
    flag: str
    label: str
    help: str
    shape: Shape
    default: Value
    required: bool
    choices: tuple[str, ...] = ()
    low: float | None = None
    high: float | None = None


def fields_of(command: Command) -> tuple[Field, ...]:
    """All options and arguments of one command, arguments first, each as a field."""
    declared = _Declared()
    command.declare(declared)
    found = [_field(action) for action in declared.actions if action.default is not SUPPRESS]
    return tuple(sorted(found, key=lambda field: field.flag != ""))


def arguments_of(fields: tuple[Field, ...], values: Mapping[str, Value]) -> list[str]:
    """Return the command line for `values` (by field name).

    Fields that are at their default, or empty, are omitted.

    Raises:
        CalibrationError: A required field is empty, or a number is none or out of range.
    """
    line: list[str] = []
    for field in fields:
        value = values.get(field.name, field.default)
        text = _text(field, value)
        if text is None:
            if field.required:
                raise CalibrationError(f"{field.label}: is needed: {field.help}")
            continue
        if field.shape == "flag":
            line += [field.flag] if value and value != field.default else []
        elif field.shape == "list":
            for part in text.replace(",", " ").split():
                line += [field.flag, part]
        elif not field.flag:
            line.append(text)
        elif field.required or value != field.default:
            line += [field.flag, text]
    return line


def _text(field: Field, value: Value) -> str | None:
    """The value as it stands on a command line; None: it is left out."""
    if value is None or value == "":
        return None
    if field.shape in ("number", "whole"):
        try:
            number = float(value)
        except ValueError as error:
            raise CalibrationError(f"{field.label}: {value!r} is no number") from error
        if (field.low is not None and number < field.low) or (field.high is not None and number > field.high):
            raise CalibrationError(
                f"{field.label}: {number:g} is not in {field.low:g} to {field.high or 1e9:g}"
            )
        if field.shape == "whole" and number != round(number):
            raise CalibrationError(f"{field.label}: {number:g} is no whole number")
        return f"{round(number)}" if field.shape == "whole" else f"{number:.12g}"
    return str(value).strip() or None


class _Declared(ArgumentParser):
    """A parser that remembers what is declared, in that order."""

    def __init__(self) -> None:
        self.actions: list[Action] = []
        super().__init__(add_help=False)

    def add_argument(self, *names: Any, **how: Any) -> Action:
        """Declare an option or an argument."""
        action = super().add_argument(*names, **how)
        self.actions.append(action)
        return action


def _field(action: Action) -> Field:
    flag = next((one for one in action.option_strings if one.startswith("--")), "")
    number = action.type if isinstance(action.type, Number) else None
    default = cast(object, action.default)
    return Field(
        action.dest,
        flag,
        label_of(action.dest),
        (action.help or "") % {"default": default},
        _shape(action),
        None if action.required or default is None or default == [] else _value(default),
        action.required,
        tuple(str(one) for one in action.choices or ()),
        None if number is None else number.low,
        None if number is None else number.high,
    )


def label_of(name: str) -> str:
    """An option's name for a person: `square_mm` is "Square (mm)"."""
    for end, unit in _UNITS.items():
        if name.endswith(end):
            return f"{name.removesuffix(end).replace('_', ' ').capitalize()} ({unit})"
    return name.replace("_", " ").capitalize()


def _value(default: object) -> Value:
    if isinstance(default, (bool, int, float, str)):
        return default
    return str(default)


def _shape(action: Action) -> Shape:
    """How an option is entered."""
    if action.nargs == 0:
        return "flag"
    if action.choices is not None:
        return "choice"
    if isinstance(action.default, list):
        return "list"
    if isinstance(action.type, Number):
        return "whole" if action.type.whole else "number"
    return "path" if action.type is Path else "text"
