"""The values that every kind of settings file is made of."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field

STRICT = ConfigDict(extra="forbid")


def no_flag(value: object) -> object:
    """The value, unless it is true or false, which pydantic takes for 1 and 0."""
    if isinstance(value, bool):
        raise ValueError("a number")  # and not 1.0 for `true`
    return value


def _torch_device(value: str) -> str:
    if not re.fullmatch(r"cpu|cuda(:\d+)?", value):
        raise ValueError("cpu, cuda, cuda:0, ...")
    return value


def _file_name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}", value):
        raise ValueError("a name of letters, digits, _, - and ., at most 100")
    return value


Number = Annotated[float, BeforeValidator(no_flag), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]
Seed = Annotated[int, BeforeValidator(no_flag), Field(ge=0)]
FileName = Annotated[str, AfterValidator(_file_name)]
Device = Annotated[str, AfterValidator(_torch_device)]
