"""What `torchid analyze` and `torchid check` print: the answer on one screen, or all tables and findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from rich.table import Table

from torchid.commands.analyze import Analysis, ScenarioAnalysis
from torchid.errors import format_count, join_names
from torchid.identifiability.base_parameters import unobservable_parameters
from torchid.log_checks import NOTE, Checked, Finding
from torchid.log_checks.findings import SEVERITIES
from torchid.logs.time_range import log_title
from torchid.problem.metrics import ROW_GROUPS
from torchid.report.analysis import (
    SetAccuracy,
    accuracy_table,
    branch_table,
    candidate_names,
    confounded_messages,
    contradicting_messages,
    describe_losses,
    describe_singular_postures,
    left_out_table,
    observability_table,
    removal_table,
    resting_message,
    sets_table,
)
from torchid.report.log_checks import finding_table, group_alike, log_heading, skipped_checks_text
from torchid.report.tables import LINES, labelled, rolling_lines, rows_within, wrap_words, written_line
from torchid.sensor_planning.observability import BaseObservability

_MOST_ATTENTION = 2
_TEXT_LINES = 2
_MOST_SCENARIOS = 4


def analysis_lines(analysis: Analysis, width: int) -> list[str]:
    """The answer, in lines of at most so many columns, but for names that are longer."""
    scenarios = sorted(analysis.scenarios, key=lambda scenario: -_lost(scenario))
    lines = [*wrap_words(_headline(scenarios), width), ""]
    if len(scenarios) == 1:
        lines += labelled("determined", _determined_text(scenarios[0]), width, _TEXT_LINES + 1)
        lines += labelled("smallest set", _smallest_text(scenarios[0]), width, _TEXT_LINES + 1)
    else:
        lines += _scenario_lines(scenarios, width)
    lines += rolling_lines(analysis.setup.rolling, width, 1)
    attention = list(_attention(analysis, scenarios))
    for text in attention[:_MOST_ATTENTION]:
        lines += labelled("attention", text, width, _TEXT_LINES)
    if len(attention) > _MOST_ATTENTION:
        lines += labelled("", f"{len(attention) - _MOST_ATTENTION} more: --verbose", width)
    lines += _accuracy_lines(analysis.accuracies, LINES - len(lines) - 1, width)
    return [*lines, written_line(analysis.output)]


def analysis_parts(analysis: Analysis, width: int) -> list[str | Table]:
    """All tables of all scenarios."""
    parts: list[str | Table] = [*rolling_lines(analysis.setup.rolling, width)]
    for scenario in analysis.scenarios:
        parts += _scenario_parts(scenario, width)
    if analysis.resting is not None:
        parts += labelled("attention", resting_message(analysis.resting), width)
    if analysis.accuracies:
        parts.append(accuracy_table(analysis.accuracies))
        for message in confounded_messages(analysis.accuracies):
            parts += labelled("confounded", message, width)
    if analysis.without:
        parts.append(left_out_table(analysis.without))
    return [*parts, written_line(analysis.output)]


# --------------------------------------------------------------------------------------------------------- the answer


def _judged_states(scenario: ScenarioAnalysis) -> Sequence[BaseObservability]:
    """The base with the proposed sensors, or else with the planned ones if each sample is to determine it."""
    if scenario.proposed is not None:
        return scenario.proposed
    return scenario.plan.observability if scenario.plan.problem.criterion == "per_sample" else ()


def _lost(scenario: ScenarioAnalysis) -> int:
    """Contact states in which the base is lost."""
    return sum(state.lost is not None for state in _judged_states(scenario))


def _headline(scenarios: Sequence[ScenarioAnalysis]) -> str:
    """The verdict on the sensors; the worst scenario comes first."""
    if not scenarios:  # a process that only helps
        return ""
    worst = scenarios[0]
    several = len(scenarios) > 1
    if not _judged_states(worst):
        return _stack_headline(worst)
    if lost := _lost(worst):  # planned sensors never lose it
        where = f"{lost} of {format_count(len(worst.states), 'contact state')}"
        if several:
            bad = f"{sum(_lost(scenario) > 0 for scenario in scenarios)} of {len(scenarios)} scenarios"
            where = f"{bad} (in {where} of {worst.name})"
        return f"The sensors of the file do not suffice: the base is unobservable in {where}."
    count = len(worst.plan.chosen)
    states = sum(len(scenario.states) for scenario in scenarios)
    if worst.proposed is not None:
        sensors = "The sensors of the file suffice"
    elif several:
        sensors = "The smallest sets suffice"
    else:
        sensors = f"{format_count(count, 'sensor')} suffice{'s' * (count == 1)}" if count else "No sensor is needed"
    return (
        f"{sensors}: the base is observable in {f'all {states} contact states' if states > 1 else 'the contact state'}."
    )


def _stack_headline(scenario: ScenarioAnalysis) -> str:
    """What the sensors determine, if all samples together are judged."""
    plan = scenario.plan
    base = scenario.base
    if scenario.proposed is not None:  # of a robot with a fixed base
        return f"The sensors of the file determine at best {base.rank} base parameters of {int(base.free.sum())}."
    sensors = f"{len(plan.chosen)} of {len(plan.problem.candidates)} sensors"
    return f"{sensors} determine {plan.stack_rank} of the {plan.stack_full} inertial base parameters of all sensors."


def _determined_text(scenario: ScenarioAnalysis) -> str:
    """How many parameters are determined alone, in combinations, and not at all."""
    base = scenario.base
    names = scenario.plan.problem.robot.body_names
    alone = int((np.count_nonzero(base.combination, axis=1) == 1).sum())
    seen = int(base.combination.any(axis=0).sum())
    free = int(base.free.sum())
    sums = f"{seen - alone} only in {format_count(base.rank - alone, 'combination')}"
    bodies = [line.partition(":")[0] for line in unobservable_parameters(base, names)]
    unobservable = f", {free - seen} not at all (of {join_names(bodies)})" if bodies else ""
    return f"at best {alone} of {free} parameters alone, {sums}{unobservable}; see base_parameters.txt"


def _smallest_text(scenario: ScenarioAnalysis) -> str:
    plan = scenario.plan
    is_own = bool(scenario.proposed) and scenario.proposed is plan.observability
    names = "the set of the file" if is_own else candidate_names(plan.chosen)
    aim = " for the inertia (without friction)" if plan.problem.criterion == "stack" else ""
    return f"{format_count(len(plan.chosen), 'sensor')}{aim}, cost {plan.cost:g}, {plan.proof}: {names}"


def _scenario_lines(scenarios: Sequence[ScenarioAnalysis], width: int) -> list[str]:
    states = [_judged_states(scenario) for scenario in scenarios]
    lost = [
        f"{_lost(scenario)} of {len(judged)} states" if judged else ""
        for scenario, judged in zip(scenarios, states, strict=True)
    ]
    columns = [
        ("base unobservable", lost),
        ("base parameters", [f"{scenario.base.rank} of {int(scenario.base.free.sum())}" for scenario in scenarios]),
        ("smallest set", [format_count(len(scenario.plan.chosen), "sensor") for scenario in scenarios]),
        ("cost", [f"{scenario.plan.cost:g}" for scenario in scenarios]),
        ("proven", ["yes" if scenario.plan.proven else "no" for scenario in scenarios]),
    ]
    names = [scenario.name for scenario in scenarios]
    return rows_within(("scenario", names), columns, width, _MOST_SCENARIOS + 2, "more scenarios: --verbose")


def _attention(analysis: Analysis, scenarios: Sequence[ScenarioAnalysis]) -> Iterator[str]:
    """What the user should look at, the most urgent first."""

    def named(scenario: ScenarioAnalysis, messages: Sequence[str]) -> Iterator[str]:
        return (f"{scenario.name}: {message}" if len(scenarios) > 1 else message for message in messages)

    for scenario in scenarios:
        yield from named(scenario, describe_losses(_judged_states(scenario)))
    if analysis.resting is not None:
        yield resting_message(analysis.resting)
    if analysis.setup.config.analysis.scenarios is None:
        for scenario in scenarios:
            accuracy = analysis.accuracies.get("proposed" if scenario.proposed is not None else scenario.plan_label)
            if accuracy is not None and accuracy.rank < scenario.base.rank:
                what = f"The logs determine {accuracy.rank} of {scenario.base.rank} base parameters"
                yield f"{what}. Record more varied motion of all joints and of the base."
    yield from contradicting_messages(analysis.without)
    yield from confounded_messages(analysis.accuracies, in_short=True)
    for scenario in scenarios:
        yield from named(scenario, describe_singular_postures(_judged_states(scenario), beyond_logs=False))


def _accuracy_lines(sets: Mapping[str, SetAccuracy], room: int, width: int) -> list[str]:
    """A table of the errors of sensor sets, measured if there were test logs, in so many lines."""
    if all(accuracy.measured is None for accuracy in sets.values()):
        return []
    if room < _FEWEST_ROWS:
        return labelled("compared", f"{format_count(len(sets), 'sensor set')}: --verbose", width)
    errors = [accuracy.measured.rms for accuracy in sets.values() if accuracy.measured is not None]
    columns = [
        (label, ["" if (rms := rms_by_group.get(group)) is None else f"{rms:.3g}" for rms_by_group in errors])
        for group, label in ROW_GROUPS.items()
    ]
    columns += [("rank", [str(accuracy.rank) for accuracy in sets.values()])]
    names = ("rms error, measured", list(sets))
    return ["", *rows_within(names, columns, width, room - 1, "more sensor sets: --verbose")]


# --------------------------------------------------------------------------------------------------------- all tables


def _scenario_parts(scenario: ScenarioAnalysis, width: int) -> list[str | Table]:
    plan = scenario.plan
    base = scenario.base
    parts: list[str | Table] = [f"Scenario {scenario.name}", branch_table(plan)]
    parts += [sets_table(plan.parts)] if plan.parts else []
    proof = "no cheaper set exists" if plan.proven else "a cheaper set may exist"
    parts += labelled("chosen", candidate_names(plan.chosen), width)
    parts += labelled("cost", f"{plan.cost:g}; {proof}", width)
    named = {"Chosen sensors": plan.observability}
    if scenario.proposed is not None and scenario.proposed is not plan.observability:
        named["Proposed sensors"] = scenario.proposed
    for title, states in named.items():
        parts += [observability_table(title, states)] if states else []
        if title != "Chosen sensors" or plan.parts:
            for message in (*describe_losses(states), *describe_singular_postures(states)):
                parts += labelled("attention", message, width)
    parts += [removal_table(plan)] if plan.removals else []
    structure = f"{base.rank} base parameters of {int(base.free.sum())} parameters"
    parts += labelled("structure", f"{structure}; see base_parameters.txt", width)
    return [*parts, *labelled("determined", _determined_text(scenario), width), ""]


_NAMED = 2  # logs of a finding
_FEWEST_ROWS = 4  # of the table of logs: empty line, heading, a log, how many others there are


def check_lines(checked: Sequence[Checked], written: Sequence[str | None], width: int) -> list[str]:
    """The answer, in lines of at most so many columns, but for names that are longer.

    Args:
        checked: all logs.
        written: files that have all of it, if any.
        width: of the terminal.
    """
    head = wrap_words(_verdict(checked), width)
    rolling = rolling_lines(checked[0].rolling, width, _TEXT_LINES) if checked else []
    skipped = _skipped_lines(checked, _TEXT_LINES, width)
    files = [written_line(name) for name in written if name]
    room = LINES - len([*head, *rolling, *skipped, *files])
    table = _FEWEST_ROWS if len(checked) > 1 else 0
    finding_lines = _finding_lines(_alike(checked), room - table, width, len(checked))
    logs = _log_lines(checked, room - len(finding_lines), width) if table else []
    skipped = _skipped_lines(checked, _TEXT_LINES + max(room - len(finding_lines) - len(logs), 0), width)
    return [*head, *finding_lines, *logs, *rolling, *skipped, *files]


def finding_parts(checked: Sequence[Checked], written: Sequence[str | None], width: int) -> list[str | Table]:
    """All findings about all logs with what to do, and what was not checked; see `check_lines`."""
    parts: list[str | Table] = [*rolling_lines(checked[0].rolling, width)] if checked else []
    for log in checked:
        parts.append(log_heading(log))
        parts += [finding_table(log.findings)] if log.findings else []
        if skipped := skipped_checks_text(log):
            parts += labelled("not checked", skipped, width)
        parts += [*labelled("verdict", log.verdict, width), ""]
    return [*parts, *(written_line(name) for name in written if name)]


# --------------------------------------------------------------------------------------------------------- the answer


@dataclass(frozen=True)
class _Alike:
    """Findings of one kind, by log: of each log one by field, all of the same samples."""

    by_log: dict[str, list[Finding]]

    @property
    def first(self) -> Finding:
        """That of the first log and field, which describes the others."""
        return next(iter(self.by_log.values()))[0]

    @property
    def severities(self) -> Counter[str]:
        """How many findings there are of each severity."""
        return Counter(finding.severity for findings in self.by_log.values() for finding in findings)


def _alike(checked: Sequence[Checked]) -> list[_Alike]:
    """All findings, the most severe first, then what rejects whole logs, then what concerns most logs."""
    groups: dict[tuple[str, ...], dict[str, list[Finding]]] = {}
    for log in checked:
        for alike in group_alike(log.findings):
            first = alike[0]
            kind = (first.severity, first.name, first.advice, *(finding.field for finding in alike))
            groups.setdefault(kind, {}).setdefault(str(log.log.source), []).extend(alike)

    def urgency(group: _Alike) -> tuple[int, bool, int]:
        return SEVERITIES.index(group.first.severity), not group.first.rejects_all, -len(group.by_log)

    return sorted(map(_Alike, groups.values()), key=urgency)


def _is_clean(log: Checked) -> bool:
    return all(finding.severity == NOTE for finding in log.findings)


def _verdict(checked: Sequence[Checked]) -> str:
    """The verdict on all logs."""
    if len(checked) == 1:
        usual = "; no mistake found" if _is_clean(checked[0]) else ""
        return f"{log_heading(checked[0])}: {checked[0].verdict}{usual}"
    clean, usable = (sum(map(condition, checked)) for condition in (_is_clean, lambda log: log.usable))
    if clean == len(checked):
        return f"No mistake found in {format_count(clean, 'log')}."
    shortened = sum(log.usable and bool(log.rejected.any()) for log in checked)
    without = f" ({shortened} without some samples)" if shortened else ""
    usable_logs = f"{usable} of {format_count(len(checked), 'log')} {'is' if usable == 1 else 'are'} usable{without}"
    return f"{usable_logs}; findings in {len(checked) - clean}."


def _finding_lines(groups: Sequence[_Alike], room: int, width: int, logs: int) -> list[str]:
    """The findings in at most so many lines, whole if they fit; else the last line counts what is not shown."""
    texts: list[list[str]] = []
    for most in (None, _TEXT_LINES):
        texts = [_finding_text(group, width, logs, most) for group in groups]
        lines = [line for text in texts for line in text]
        is_whole = most is None and all(len(group.by_log) == 1 for group in groups)
        end = [] if is_whole else ["full text: --verbose"]
        if len(lines) + len(end) <= room:
            return lines + end
    shown = sum(last < room for last in accumulate(map(len, texts)))
    return [*(line for text in texts[:shown] for line in text), _hidden_text(groups[shown:])]


def _finding_text(group: _Alike, width: int, logs: int, most: int | None) -> list[str]:
    """What was found in which logs, and what to do, each in at most so many lines."""
    (log, findings), *others = group.by_log.items()
    where = f" in {log_title(log)}" if logs > 1 else ""
    if others:
        where += f", also {join_names([log_title(other) for other, _ in others], _NAMED - 1)}"
    fields = join_names(list(dict.fromkeys(finding.field for finding in findings)))
    what = f"{fields} ({group.first.name}){where}: {group.first.found}"
    return [*labelled(group.first.severity, what, width, most), *labelled("", f"do: {group.first.advice}", width, most)]


def _hidden_text(groups: Sequence[_Alike]) -> str:
    counts = sum((group.severities for group in groups), Counter[str]())
    named = (f"{count} {kind}{'s' * (kind == NOTE and count > 1)}" for kind in SEVERITIES if (count := counts[kind]))
    return f"and {', '.join(named)} more: --verbose"


def _log_lines(checked: Sequence[Checked], room: int, width: int) -> list[str]:
    """A table of the logs, the worst first, in at most so many lines."""
    order = sorted(checked, key=_severity, reverse=True)
    counts = [Counter(finding.severity for finding in log.findings) for log in order]
    columns = [
        ("usable", [_usable_text(log) for log in order]),
        *((severity, [str(count[severity] or "") for count in counts]) for severity in SEVERITIES),
        ("samples", [str(len(log.log)) for log in order]),
        ("seconds", [f"{log.log.time[-1] - log.log.time[0]:.4g}" for log in order]),
    ]
    names = ("log", [log_title(log.log.source) for log in order])
    return ["", *rows_within(names, columns, width, room - 1, "more logs without worse findings: --verbose")]


def _severity(log: Checked) -> tuple[float, ...]:
    counts = Counter(finding.severity for finding in log.findings)
    return (not log.usable, float(log.rejected.mean()), *(counts[severity] for severity in SEVERITIES))


def _usable_text(log: Checked) -> str:
    count = int(log.rejected.sum())
    return "no" if not log.usable else f"without {format_count(count, 'sample')}" if count else "yes"


def _skipped_lines(checked: Sequence[Checked], most: int, width: int) -> list[str]:
    """Checks that could not be made, each with the reasons of the first log that gives some, and how many logs do."""
    reasons: dict[str, list[str]] = {}
    for log in checked:
        for name, reason in {skip.name: skip.reason for skip in log.skipped}.items():
            reasons.setdefault(name, []).append(reason)
    texts = []
    for name, of_logs in reasons.items():
        alike = " or similar" if len(set(of_logs)) > 1 else ""
        where = "" if len(of_logs) == len(checked) else f", in {len(of_logs)} of {len(checked)} logs"
        texts.append(f"{name} ({of_logs[0]}{alike}{where})")
    text = f"{format_count(len(texts), 'check')}: {'; '.join(texts)}"
    return labelled("not checked", text, width, most) if texts else []
