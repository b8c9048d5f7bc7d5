"""Checks of a saved training state: the structure of a new one, and every number in its range."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

_FREE = ("residual_weight", "weight_choice")  # None or not, whatever they are in a new state
_SCHEDULED = ("lr", "momentum", "betas")  # of an optimizer's groups; all else is as the settings say


def validate_state(found: Mapping[str, Any], new: Mapping[str, Any], epochs: int) -> None:
    """Refuse a state that no descent of the same settings can have left.

    Args:
        found: the state.
        new: the state of a descent that has not begun.
        epochs: after which the descent ends.

    Raises:
        ValueError: names the place, what was found and what is accepted.
    """
    require_same_structure(found, {name: value for name, value in new.items() if name not in _FREE})
    epoch, best_epoch, best_loss = (found[name] for name in ("epoch", "best_epoch", "best_loss"))
    _require_count("epoch", epoch, epochs)
    _require_count("best_epoch", best_epoch, epoch)
    if not (best_loss >= 0.0 and np.isfinite(best_loss) == (best_epoch > 0)):
        raise ValueError(f"best_loss: found {best_loss}; accepted: at least 0, infinite before the first epoch alone")
    for place in ("learned", "best"):
        _require_learned(place, found[place], new[place])
    for number, (group, fresh) in enumerate(
        zip(found["optimizer"]["param_groups"], new["optimizer"]["param_groups"], strict=True)
    ):
        for name, value in fresh.items():
            _require_option(f"optimizer.param_groups.{number}.{name}", group[name], value, name in _SCHEDULED)
    if found["schedule"] is not None and found["schedule"].get("last_epoch") != epoch:
        last = found["schedule"].get("last_epoch")
        raise ValueError(f"schedule.last_epoch: found {last}; accepted: {epoch}, the epoch")
    _require_weight(found.get("residual_weight"), new["residual_weight"], epoch)


def require_same_structure(found: Any, expected: Any, place: str = "state") -> None:
    """Refuse a state whose keys, types or shapes are not those of a descent that has not begun; values may differ.

    A mapping that is empty in `expected`, an optimizer's state before its first step, may hold mappings.

    Raises:
        ValueError: names the first place that differs.
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
            require_same_structure(found.get(key), expected[key], f"{place}.{key}")
    elif isinstance(expected, (list, tuple)) and expected:
        if len(found) != len(expected):
            raise ValueError(f"{place} is of another length")
        for index, (one, other) in enumerate(zip(found, expected, strict=True)):
            require_same_structure(one, other, f"{place}.{index}")


def _require_count(name: str, value: Any, most: int) -> None:
    if not (isinstance(value, int) and 0 <= value <= most):
        raise ValueError(f"{name}: found {value}; accepted: a whole number from 0 to {most}")


def _require_learned(place: str, found: Mapping[str, Tensor], new: Mapping[str, Tensor]) -> None:
    for name, value in new.items():
        if value.is_floating_point() and not bool(found[name].isfinite().all()):
            raise ValueError(f"{place}.{name}: found a number that is not finite; accepted: finite numbers")


def _require_option(place: str, found: Any, new: Any, changes: bool) -> None:
    if changes and not all(np.isfinite(x) and x >= 0.0 for x in np.atleast_1d(found)):
        raise ValueError(f"{place}: found {found}; accepted: finite numbers of at least 0")
    if not changes and found != new:
        raise ValueError(f"{place}: found {found}; accepted: {new}, as in the settings")


def _require_weight(found: Any, given: float | None, epoch: int) -> None:
    """The weight of a residual module: the one that is given, or one that the first epoch chose."""
    if given is None and epoch > 0:
        if not (isinstance(found, (int, float)) and np.isfinite(found) and found >= 0.0):
            raise ValueError(f"residual_weight: found {found}; accepted: a finite number of at least 0")
    elif found != given:
        raise ValueError(f"residual_weight: found {found}; accepted: {given}")
