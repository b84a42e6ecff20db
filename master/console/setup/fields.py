"""Form fields of a calibration, read off the command's own options, so that page and command line cannot differ."""

import inspect
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Union, cast, get_args, get_origin, get_type_hints

from typer.models import ArgumentInfo, OptionInfo

from common.errors import CalibrationError

Shape = Literal["text", "number", "whole", "flag", "choice", "path", "list"]
Value = str | float | bool | None
_UNITS = {"_m_s": "m/s", "_mm": "mm", "_px": "px", "_ms": "ms", "_deg": "°"}


@dataclass(frozen=True, slots=True)
class Field:
    """One option or argument of a command.

    Attributes:
        name: The function's name of it.
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


def fields_of(command: Callable[..., None]) -> tuple[Field, ...]:
    """All options and arguments of one command, arguments first, each as a field.

    Raises:
        TypeError: The command has a parameter that is neither option nor argument.
    """
    hints = cast(dict[str, object], get_type_hints(command, include_extras=True))
    found = [
        _field(parameter, hints[name]) for name, parameter in inspect.signature(command).parameters.items()
    ]
    return tuple(sorted(found, key=lambda field: field.flag != ""))


def arguments_of(fields: tuple[Field, ...], values: Mapping[str, Value]) -> list[str]:
    """The command line that says `values` (by field name); what is at its default, or empty, is left out.

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


def _field(parameter: inspect.Parameter, hint: object) -> Field:
    if get_origin(hint) is not Annotated:
        raise TypeError(f"{parameter.name}: neither a typer option nor an argument")
    kind, *notes = get_args(hint)
    info = next((note for note in notes if isinstance(note, (OptionInfo, ArgumentInfo))), None)
    if info is None:
        raise TypeError(f"{parameter.name}: neither a typer option nor an argument")
    # In Annotated the first name of an option stands where its default would: typer's convention.
    first = (info.default,) if isinstance(info.default, str) else ()
    declared = (*first, *(info.param_decls or ()))
    long = next((one for one in declared if one.startswith("--")), f"--{parameter.name.replace('_', '-')}")
    flag = long if isinstance(info, OptionInfo) else ""
    default = cast(object, parameter.default)
    required = default is inspect.Parameter.empty and info.default_factory is None
    shape, choices = _shape(kind)
    return Field(
        parameter.name,
        flag,
        label_of(parameter.name),
        str(info.help or ""),
        shape,
        None if required or default is None or default is inspect.Parameter.empty else _value(default),
        required,
        choices,
        None if info.min is None else float(info.min),
        None if info.max is None else float(info.max),
    )


def label_of(name: str) -> str:
    """A parameter's name for a person: `square_mm` is "Square (mm)"."""
    for end, unit in _UNITS.items():
        if name.endswith(end):
            return f"{name.removesuffix(end).replace('_', ' ').capitalize()} ({unit})"
    return name.replace("_", " ").capitalize()


def _value(default: object) -> Value:
    if isinstance(default, (bool, int, float, str)):
        return default
    return str(default)


def _shape(kind: object) -> tuple[Shape, tuple[str, ...]]:
    """How a type is entered, and the choices of a choice."""
    if get_origin(kind) in (Union, types.UnionType):
        return _shape(next(part for part in get_args(kind) if part is not type(None)))
    if hasattr(kind, "__value__"):
        return _shape(getattr(kind, "__value__", None))
    if get_origin(kind) is Literal:
        return "choice", tuple(str(one) for one in get_args(kind))
    if get_origin(kind) is list:
        return "list", ()
    shapes: dict[object, Shape] = {bool: "flag", int: "whole", float: "number", Path: "path"}
    return shapes.get(kind, "text"), ()
