"""What `torchid check` prints: how many logs are free of usual mistakes and the worst findings, or every finding."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from torchid.errors import format_count, join_names
from torchid.log_checks import NOTE, Checked, Finding
from torchid.log_checks.findings import SEVERITIES
from torchid.logs.time_range import log_title
from torchid.report.log_checks import finding_table, group_alike, log_heading, skipped_checks_text
from torchid.report.tables import print_tables, terminal_width
from torchid.terminal.lines import CUT, LABEL, LINES, column_lines, labelled, print_labelled, print_rolling, wrap_words

_TEXT_LINES = 2
#: Lines of a finding and of a note, the first in which all have room.
_LEVELS = ((None, None), (None, _TEXT_LINES), (_TEXT_LINES + 1, _TEXT_LINES), (_TEXT_LINES, _TEXT_LINES))
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\w.+-]*")
_NAMED = 2  # logs of a finding
_FEWEST_ROWS = 4  # of the table of logs: empty line, heading, a log, how many others there are


def print_checks(checked: Sequence[Checked], written: Sequence[str | None]) -> None:
    """Print the answer for the terminal's width; `written`: files that have all of it, if any."""
    print("\n".join(check_lines(checked, written, terminal_width())))


def check_lines(checked: Sequence[Checked], written: Sequence[str | None], width: int) -> list[str]:
    """The answer, in lines of at most so many columns, but for names that are longer; see `print_checks`."""
    head = wrap_words(_headline(checked), width)
    rolling = labelled("contacts", checked[0].rolling, width, _TEXT_LINES) if checked and checked[0].rolling else []
    skipped = _skipped_lines(checked, _TEXT_LINES, width)
    files = [f"{'written to':{LABEL}}{name}" for name in written if name]
    room = LINES - len([*head, *rolling, *skipped, *files])
    table = _FEWEST_ROWS if len(checked) > 1 else 0
    found = _finding_lines(_alike(checked), room - table, width, len(checked))
    logs = _log_lines(checked, room - len(found), width) if table else []
    skipped = _skipped_lines(checked, _TEXT_LINES + max(room - len(found) - len(logs), 0), width)
    return [*head, *found, *logs, *rolling, *skipped, *files]


def print_all_findings(checked: Sequence[Checked], written: Sequence[str | None]) -> None:
    """Print all findings about all logs with what to do, and what was not checked; see `print_checks`."""
    if checked:
        print_rolling(checked[0].rolling)
    for log in checked:
        print(log_heading(log))
        if log.findings:
            print_tables(finding_table(log.findings))
        if skipped := skipped_checks_text(log):
            print_labelled("not checked", skipped)
        print_labelled("verdict", log.verdict)
        print()
    for name in written:
        if name:
            print(f"{'written to':{LABEL}}{name}")


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
        for found in group_alike(log.findings):
            first = found[0]
            kind = (first.severity, first.name, first.advice, *(finding.field for finding in found))
            groups.setdefault(kind, {}).setdefault(str(log.log.source), []).extend(found)

    def urgency(one: _Alike) -> tuple[int, bool, int]:
        return SEVERITIES.index(one.first.severity), not one.first.rejects_all, -len(one.by_log)

    return sorted(map(_Alike, groups.values()), key=urgency)


def _is_clean(log: Checked) -> bool:
    return all(finding.severity == NOTE for finding in log.findings)


def _headline(checked: Sequence[Checked]) -> str:
    """The verdict on all logs."""
    if len(checked) == 1:
        usual = "; free of usual mistakes" if _is_clean(checked[0]) else ""
        return f"{log_heading(checked[0])}: {checked[0].verdict}{usual}"
    clean, usable = (sum(map(of, checked)) for of in (_is_clean, lambda log: log.usable))
    if clean == len(checked):
        return f"{clean} of {format_count(clean, 'log')} are free of usual mistakes"
    shortened = sum(log.usable and bool(log.rejected.any()) for log in checked)
    some = f", {shortened} of them without some samples" if shortened else ""
    free = f"{clean or 'none'} {'is' if clean < 2 else 'are'} free of usual mistakes"
    return f"{usable} of {format_count(len(checked), 'log')} {'is' if usable == 1 else 'are'} usable{some}; {free}"


def _finding_lines(found: Sequence[_Alike], room: int, width: int, logs: int) -> list[str]:
    """The findings in at most so many lines, whole if they fit; else the last line counts what is not shown.

    Notes are shortened first, and those that have no room are left out before other findings are shortened.
    """
    severe = sum(one.first.severity != NOTE for one in found)
    texts, shown = [], 0
    for most, of_note in _LEVELS if found else ():
        limits = (of_note if one.first.severity == NOTE else most for one in found)
        texts = [_finding_text(one, width, logs, limit) for one, limit in zip(found, limits, strict=True)]
        lines = [line for text in texts for line in text]
        whole = not any(line.endswith(CUT) for line in lines) and all(len(one.by_log) == 1 for one in found)
        end = [] if whole else ["all in full: --verbose"]
        if len(lines) + len(end) <= room:
            return lines + end
        shown = sum(last < room for last in accumulate(map(len, texts[:-1])))
        if of_note and shown >= max(severe, 1):
            break
    return [*(line for text in texts[:shown] for line in text), _hidden_text(found[shown:])] if found else []


def _finding_text(one: _Alike, width: int, logs: int, most: int | None) -> list[str]:
    """What was found in which logs, and what to do, each in at most so many lines."""
    (log, findings), *others = one.by_log.items()
    where = f" in {log_title(log)}" if logs > 1 else ""
    if others:
        where += f", likewise {join_names([log_title(other) for other, _ in others], _NAMED - 1)}"
    fields = join_names(list(dict.fromkeys(finding.field for finding in findings)))
    found = f"{fields}, {one.first.name}{where}: {one.first.found}"
    return [*labelled(one.first.severity, found, width, most), *labelled("", f"do: {one.first.advice}", width, most)]


def _hidden_text(found: Sequence[_Alike]) -> str:
    counts = sum((one.severities for one in found), Counter[str]())
    named = (f"{count} {kind}{'s' * (kind == NOTE and count > 1)}" for kind in SEVERITIES if (count := counts[kind]))
    return f"and {', '.join(named)} more: --verbose"


def _log_lines(checked: Sequence[Checked], room: int, width: int) -> list[str]:
    """A table of the logs, the worst first, in at most so many lines."""
    order = sorted(checked, key=_severity, reverse=True)
    most = room - 2 if len(checked) <= room - 2 else room - 3  # an empty line, a heading, how many others there are
    shown = order[: max(most, 1)]
    counts = [Counter(finding.severity for finding in log.findings) for log in shown]
    columns = [
        ("usable", [_usable_text(log) for log in shown]),
        *((severity, [str(count[severity] or "") for count in counts]) for severity in SEVERITIES),
        ("samples", [str(len(log.log)) for log in shown]),
        ("seconds", [f"{log.log.time[-1] - log.log.time[0]:.4g}" for log in shown]),
    ]
    lines = column_lines(("log", [log_title(log.log.source) for log in shown]), columns, width)
    if len(checked) > len(shown):
        lines.append(f"and {format_count(len(checked) - len(shown), 'log')} more, no worse than these: --verbose")
    return ["", *lines]


def _severity(log: Checked) -> tuple[float, ...]:
    counts = Counter(finding.severity for finding in log.findings)
    return (not log.usable, float(log.rejected.mean()), *(counts[severity] for severity in SEVERITIES))


def _usable_text(log: Checked) -> str:
    count = int(log.rejected.sum())
    return "no" if not log.usable else f"without {format_count(count, 'sample')}" if count else "yes"


def _skipped_lines(checked: Sequence[Checked], most: int, width: int) -> list[str]:
    """Checks that could not be made, with the reasons, and the number of logs if it is not all."""
    alike: dict[tuple[str, str], list[str]] = {}  # but for numbers, one of each log
    for log in checked:
        for key, reason in {(skip.name, _NUMBER.sub("", skip.reason)): skip.reason for skip in log.skipped}.items():
            alike.setdefault(key, []).append(reason)
    reasons: dict[str, list[str]] = {}
    for (name, _), of_logs in alike.items():
        or_alike = " or alike" if len(set(of_logs)) > 1 else ""
        of_some = "" if len(of_logs) == len(checked) else f", {len(of_logs)} of {len(checked)} logs"
        reasons.setdefault(name, []).append(f"{of_logs[0]}{or_alike}{of_some}")
    texts = [f"{name} ({'; '.join(of_name)})" for name, of_name in reasons.items()]
    text = f"{format_count(len(texts), 'check')}: {'; '.join(texts)}"
    return labelled("not checked", text, width, most) if texts else []
