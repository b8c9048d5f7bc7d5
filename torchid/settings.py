"""Types of settings, and their check in files and constructors."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import ErrorDetails


def _not_bool(value: object) -> object:
    """The value; ValueError for true and false, which pydantic accepts as 1 and 0."""
    if isinstance(value, bool):
        raise ValueError("a number")
    return value


def _has_name(value: dict[str, Any]) -> dict[str, Any]:
    if not isinstance(value.get("name"), str):
        raise ValueError("a mapping with the name of a class and its options: {name: Adam, lr: 0.05}")
    return value


def _torch_device(value: str) -> str:
    if not re.fullmatch(r"cpu|cuda(:\d+)?", value):
        raise ValueError("cpu, cuda, cuda:0, ...")
    return value


def _file_name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}", value):
        raise ValueError("a name of at most 100 letters, digits, _, - and .")
    return value


def described(accepted: str) -> WrapValidator:
    """State what a type accepts, in place of pydantic's own message."""

    def validate(value: object, handler: ValidatorFunctionWrapHandler) -> object:
        try:
            return handler(value)
        except ValueError as error:
            raise ValueError(accepted) from error

    return WrapValidator(validate)


STRICT = ConfigDict(extra="forbid")
"""For blocks of settings: unknown keys are refused."""

AUTO: Literal["auto"] = "auto"
"""The data choose the value."""

Number = Annotated[float, BeforeValidator(_not_bool), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
Auto = Literal["auto"]
PositiveOrAuto = Annotated[Positive | Auto | None, described("auto, null, or a number greater than 0")]
"""A positive number, a number chosen by the data, or none."""
NumberOrAuto = Annotated[Number | Auto | None, described("auto, null, or a number")]
"""A number, a number chosen by the data, or none."""
NotNegative = Annotated[Number, Field(ge=0.0)]
BoolOrAuto = Annotated[bool | Auto, described("true, false, or auto")]
"""A switch, or a choice of the data."""
NotNegativeOrAuto = Annotated[NotNegative | Auto, described("auto, or a number of at least 0")]
"""A number of at least 0, or a number chosen by the data."""
NotNegativeAutoOrNone = Annotated[NotNegative | Auto | None, described("auto, null, or a number of at least 0")]
"""A number of at least 0, a number chosen by the data, or none."""
FileName = Annotated[str, AfterValidator(_file_name)]
Device = Annotated[str, AfterValidator(_torch_device)]
RidgeRule = Literal["auto", "one_standard_error"]
"""Rule for the ridge: the first unless a larger one predicts better, or the largest within one standard error."""
Ridge = Annotated[NotNegative | RidgeRule, described("auto, one_standard_error, or a number of at least 0")]
"""A ridge, or a rule for it."""
BelowOne = Annotated[Number, Field(ge=0.0, lt=1.0)]
Tolerance = Annotated[Number, Field(gt=0.0, lt=1.0)]
Count = Annotated[int, BeforeValidator(_not_bool), Field(ge=1)]
Seed = Annotated[int, BeforeValidator(_not_bool), Field(ge=0)]
Name = Annotated[str, Field(min_length=1)]
NamedClass = Annotated[dict[str, Any], AfterValidator(_has_name)]
"""A class of another package by its name, and its options: `{name: Adam, lr: 0.05}`."""


def validate_settings(settings: object) -> None:
    """Check the fields of a dataclass against their annotated types; for its `__post_init__`.

    Raises:
        ValueError: names the field, its value and the accepted values.
    """
    for name, adapter in _adapters(type(settings)).items():  # type: ignore[arg-type]  # mypy: no type is hashable
        value = getattr(settings, name)
        try:
            adapter.validate_python(value)
        except ValidationError as error:
            raise ValueError(f"{name}: found {value!r}; accepted: {accepted_values(error.errors()[0])}") from None


def accepted_values(error: ErrorDetails) -> str:
    """Text of the accepted values of a type, from the error of a value."""
    count = error.get("ctx", {}).get("min_length", 1)
    plain: Mapping[str, str] = {
        "float_parsing": "a number",
        "float_type": "a number",
        "int_parsing": "a whole number",
        "int_type": "a whole number",
        "int_from_float": "a whole number",
        "bool_parsing": "true or false",
        "bool_type": "true or false",
        "string_type": "a text",
        "path_type": "a path",
        "list_type": "a list",
        "dict_type": "a mapping",
        "too_short": f"at least {count} items",
        "string_too_short": "a name",
    }
    described = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return plain.get(error["type"], described)


@cache
def _adapters(settings: type) -> dict[str, TypeAdapter[Any]]:
    hints = get_type_hints(settings, include_extras=True)
    return {name: TypeAdapter(hint) for name, hint in hints.items() if _is_checked(hint)}


def _is_checked(hint: Any) -> bool:
    return get_origin(hint) in (Annotated, Literal) or any(map(_is_checked, get_args(hint)))
