"""What a saved state of a descent must be: made of the same as a new one's, every number in its range."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

_FREE = ("residual_weight", "weight_choice")  # None or not, whatever they are in a new state
_SCHEDULED = ("lr", "momentum", "betas")  # of an optimizer's groups; all else is as the settings say


def check_state(found: Mapping[str, Any], new: Mapping[str, Any], epochs: int) -> None:
    """Make sure that a state can be one that a descent of the same settings has left.

    Args:
        found: the state.
        new: the state of a descent that has not begun.
        epochs: after which the descent ends.

    Raises:
        ValueError: names the place, what was found and what is accepted.
    """
    check_alike(found, {name: value for name, value in new.items() if name not in _FREE})
    epoch, best_epoch, best_loss = (found[name] for name in ("epoch", "best_epoch", "best_loss"))
    _check_count("epoch", epoch, epochs)
    _check_count("best_epoch", best_epoch, epoch)
    if not (best_loss >= 0.0 and np.isfinite(best_loss) == (best_epoch > 0)):
        raise ValueError(f"best_loss: found {best_loss}; accepted: at least 0, infinite before the first epoch alone")
    for place in ("learned", "best"):
        _check_learned(place, found[place], new[place])
    for number, (group, fresh) in enumerate(
        zip(found["optimizer"]["param_groups"], new["optimizer"]["param_groups"], strict=True)
    ):
        for name, value in fresh.items():
            _check_option(f"optimizer.param_groups.{number}.{name}", group[name], value, name in _SCHEDULED)
    if found["schedule"] is not None and found["schedule"].get("last_epoch") != epoch:
        last = found["schedule"].get("last_epoch")
        raise ValueError(f"schedule.last_epoch: found {last}; accepted: {epoch}, the epoch")
    _check_weight(found.get("residual_weight"), new["residual_weight"], epoch)


def check_alike(found: Any, expected: Any, place: str = "state") -> None:
    """Compare a state with that of a descent that has not begun: what it is made of, not its values.

    A mapping that is empty in `expected`, an optimizer's state before its first step, may hold mappings.

    Raises:
        ValueError: something else stands in some place.
    """
    if isinstance(expected, Tensor):
        alike = isinstance(found, Tensor) and (found.shape, found.dtype) == (expected.shape, expected.dtype)
    elif isinstance(expected, (int, float)):
        number = isinstance(found, (int, float)) and found == found
        alike = number and isinstance(found, bool) == isinstance(expected, bool)
    else:
        alike = isinstance(found, type(expected))
    if alike and expected == {}:
        alike = all(isinstance(value, dict) for value in found.values())
    if not alike:
        raise ValueError(f"{place} is of another kind")
    if isinstance(expected, Mapping) and expected:
        for key in expected:
            check_alike(found.get(key), expected[key], f"{place}.{key}")
    elif isinstance(expected, (list, tuple)) and expected:
        if len(found) != len(expected):
            raise ValueError(f"{place} is of another length")
        for index, (one, other) in enumerate(zip(found, expected, strict=True)):
            check_alike(one, other, f"{place}.{index}")


def _check_count(name: str, value: Any, most: int) -> None:
    if not (isinstance(value, int) and 0 <= value <= most):
        raise ValueError(f"{name}: found {value}; accepted: a whole number from 0 to {most}")


def _check_learned(place: str, found: Mapping[str, Tensor], new: Mapping[str, Tensor]) -> None:
    for name, value in new.items():
        if value.is_floating_point() and not bool(found[name].isfinite().all()):
            raise ValueError(f"{place}.{name}: found a number that is not finite; accepted: finite numbers")


def _check_option(place: str, found: Any, new: Any, changes: bool) -> None:
    if changes and not all(np.isfinite(x) and x >= 0.0 for x in np.atleast_1d(found)):
        raise ValueError(f"{place}: found {found}; accepted: finite numbers of at least 0")
    if not changes and found != new:
        raise ValueError(f"{place}: found {found}; accepted: {new}, as in the settings")


def _check_weight(found: Any, given: float | None, epoch: int) -> None:
    """The weight of a residual module: the one that is given, or one that the first epoch chose."""
    if given is None and epoch > 0:
        if not (isinstance(found, (int, float)) and np.isfinite(found) and found >= 0.0):
            raise ValueError(f"residual_weight: found {found}; accepted: a finite number of at least 0")
    elif found != given:
        raise ValueError(f"residual_weight: found {found}; accepted: {given}")
