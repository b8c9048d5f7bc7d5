"""Where identified parameters predict worse than the URDF's, on data that the fit has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torchid.report.metrics import SHOWN, Metrics, group_name
from torchid.report.sums import WHITENED
from torchid.text import listed

JUDGED = ("joint_torque", "base_force", "base_moment", WHITENED)
"""Groups of rows that decide; what is projected without whitening repeats them."""

_CLEARLY = 1.05  # ratio of errors: what is closer is as good
_MATTERS = 1e-3  # share of the measured: two models that leave less, as on data without noise, are equally good


@dataclass(frozen=True)
class Worse:
    """A group of rows on a set of logs in which the URDF's parameters predict better, with both errors."""

    logs: str
    group: str
    nominal: float
    identified: float

    def __str__(self) -> str:
        return described(self.group, self.identified, self.nominal) or self.group


def described(group: str, identified: float | None, nominal: float | None) -> str | None:
    """Both errors of a group of rows in words, None where it has none."""
    if identified is None or nominal is None:
        return None
    unit = SHOWN[group].split("[")[1].rstrip("]")
    name = "whitened projected residual" if group == WHITENED else group_name(group)
    return f"{name} {identified:.3g} against {nominal:.3g} {unit}"


def worse_than_nominal(sets: Mapping[str, tuple[Metrics, Metrics]]) -> list[Worse]:
    """Groups of rows where identified parameters are clearly worse than nominal ones.

    Args:
        sets: nominal and identified metrics by name of the logs.
    """
    found = []
    for logs, (nominal, identified) in sets.items():
        for group in JUDGED:
            before, after = nominal.rms.get(group), identified.rms.get(group)
            if before is None or after is None:
                continue
            share = identified.relative.get(group)
            measured = after / share if share else 0.0
            if after > _CLEARLY * before and after - before > _MATTERS * measured:
                found.append(Worse(logs, group, before, after))
    return found


def verdict(found: list[Worse]) -> str | None:
    """One line of what is worse, None if nothing is."""
    if not found:
        return None
    by_logs = {one.logs: [str(other) for other in found if other.logs == one.logs] for one in found}
    told = "; ".join(f"on {logs}: {listed(texts)}" for logs, texts in by_logs.items())
    return f"the identified parameters predict worse than the URDF's, {told}"


ADVICE = (
    "do not use them before you know why: run torchid check on the same file, set a larger estimator.ridge (auto "
    "chooses one), or record more and other motion"
)
"""What to do about it."""
