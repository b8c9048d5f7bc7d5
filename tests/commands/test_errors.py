"""Errors cross from one process to another as they are."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from motions import moving_log

from torchid.errors import (
    BaseLostError,
    ConfigError,
    InputError,
    LogError,
    SensorError,
    TorchidError,
    TorchidWarning,
    UnknownNameError,
    UrdfError,
    about_file,
    current_file,
    during,
    warn,
    warn_about_file,
)
from torchid.logs.log import UnknownFieldError
from torchid.logs.preprocess import preprocess

PLAIN = [kind("a.yaml", "field", "a\nb", "c") for kind in (InputError, UrdfError, LogError, ConfigError, SensorError)]
NAMED = [kind("a.yaml", "field", "l_nee", ("l_knee", "r_knee")) for kind in (UnknownNameError, UnknownFieldError)]


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("error", [*PLAIN, *NAMED, BaseLostError("rank 3")], ids=lambda error: type(error).__name__)
def test_an_error_that_was_pickled_is_the_same_error(error: TorchidError, protocol: int) -> None:
    back = pickle.loads(pickle.dumps(error, protocol))
    assert type(back) is type(error)
    assert str(back) == str(error)
    assert vars(back) == vars(error)


def test_an_unknown_name_keeps_the_names_that_are_known() -> None:
    back = pickle.loads(pickle.dumps(UnknownNameError("a.yaml", "joint", "l_nee", ["l_knee", "x"])))
    assert (back.name, back.valid) == ("l_nee", ("l_knee", "x"))
    assert str(back) == "a.yaml: joint: unknown name 'l_nee'; accepted: l_knee"


def test_a_message_is_one_line_whatever_was_found() -> None:
    assert str(PLAIN[0]) == "a.yaml: field: a b; accepted: c"


def test_a_warning_is_of_the_line_outside_of_torchid_that_led_to_it_however_deep() -> None:
    log = moving_log(np.array([0.0, 0.01, 0.02, 0.0201, 0.03, 0.04, 0.05, 0.06]))
    with pytest.warns(TorchidWarning, match="a step of") as caught:
        preprocess(log)
    assert [Path(one.filename) for one in caught] == [Path(__file__)]
    with pytest.warns(TorchidWarning, match="^a gap$") as direct:
        warn("a gap")
    assert Path(direct[0].filename) == Path(__file__)


def test_a_warning_begins_with_the_file_that_it_is_about_if_there_is_one() -> None:
    with about_file("walk.npz"), pytest.warns(TorchidWarning, match=r"^walk.npz: a gap$") as caught:
        warn_about_file("a gap")
    assert Path(caught[0].filename) == Path(__file__)
    with pytest.warns(TorchidWarning, match="^a gap$"):
        warn_about_file("a gap")


def test_an_error_that_names_a_field_alone_is_about_the_innermost_file_and_stays_so() -> None:
    with about_file("walk.npz"):
        with during("reading", "jump.npz"):
            inner = LogError.at_field("time", "no samples", "some")
        outer = LogError.at_field("time", "no samples", "some")
    assert current_file() == ""
    assert str(inner) == "jump.npz: time: no samples; accepted: some"
    assert str(outer) == "walk.npz: time: no samples; accepted: some"
    assert str(ConfigError.at_field("ridge", "-1", "0 or more")) == "ridge: -1; accepted: 0 or more"
    back = pickle.loads(pickle.dumps(inner))  # in a process that works on no file or on another one
    assert (type(back), str(back)) == (LogError, str(inner))
