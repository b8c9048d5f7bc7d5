"""How much better than the URDF's some parameters predict forces, in a sentence and a few errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchid.problem import Metrics
from torchid.problem.metrics import DECISIVE_GROUPS, ERROR_GROUPS

_FEW_GROUPS = 2
_IN_PART = " in part"
#: By the least and the largest error of a group of rows, as shares of the URDF's.
_VERDICTS = {
    (0.5, 0.5): "Much better",
    (0.95, 0.95): "Better",
    (0.95, np.inf): f"Better{_IN_PART}",
}
_NO_BETTER = "No better"
_AT_THE_FLOOR = 1.3  # times the error that noise of the readings leaves


@dataclass(frozen=True)
class Judged:
    """Errors of nominal and of identified parameters.

    Attributes:
        text: where the motion is from.
        nominal: errors of the nominal parameters.
        identified: likewise.
        of: what the nominal parameters are those of, "URDF" or "MJCF".
    """

    text: str
    nominal: Metrics
    identified: Metrics
    of: str

    def errors(self, groups: Sequence[str] = DECISIVE_GROUPS) -> Iterator[tuple[str, float, float, float | None]]:
        """Groups of rows with both errors, and what noise of the readings leaves."""
        for group in groups:
            before, after = self.nominal.rms_of(group), self.identified.rms_of(group)
            if before is not None and after is not None:
                yield group, before, after, self.identified.noise.get(group)

    def headline(self, *, explained: bool = True) -> str:
        """The verdict in a sentence.

        Args:
            explained: whether the model explains the forces that it was fitted to.
        """
        ratios = [after / before if before else 1.0 for _, before, after, _ in self.errors()]
        if not ratios:
            return f"Nothing to compare with the {self.of} on {self.text}"
        least, most = min(ratios), max(ratios)
        shares = f"{_percent(least)} to {_percent(most)} %" if most > 1.1 * least else f"{_percent(most)} %"
        within = (text for limits, text in _VERDICTS.items() if least < limits[0] and most < limits[1])
        verdict = next(within, _NO_BETTER)
        known = [after / floor for _, _, after, floor in self.errors() if floor]
        floor = ", as near as the sensors' noise allows" if known and max(known) < _AT_THE_FLOOR else ""
        if not explained:
            floor = f", {'and' if verdict == _NO_BETTER else 'but'} the model does not explain these forces"
        words, part = verdict.removesuffix(_IN_PART), _IN_PART * verdict.endswith(_IN_PART)
        return f"{words} than the {self.of}{part} on {self.text}: errors of {shares} of the {self.of}'s{floor}"

    def shown_errors(self) -> list[tuple[str, float, float, float | None]]:
        """Errors that a user should see, by the words for their group, with units."""
        few = len(list(self.errors())) < _FEW_GROUPS  # no joint of its own, as all legs stand: their projection
        errors = self.errors(tuple(ERROR_GROUPS) if few else DECISIVE_GROUPS)
        return [(self.identified.label(group), before, after, floor) for group, before, after, floor in errors]


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f}" if share >= 0.1 else f"{100.0 * share:.2g}"
