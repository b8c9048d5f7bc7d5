"""What `torchid check` says on one screen."""

from __future__ import annotations

import io
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from repository import DEMO

from torchid.cli import main
from torchid.log_checks import NOTE, REJECTED, SUSPICIOUS, Checked, Finding, Skipped, Span
from torchid.logs import Log, write_log
from torchid.report.tables import LINES
from torchid.terminal.analysis import check_lines

SPIKE = Finding(
    "spike", REJECTED, "joint_torque", "excursions of 200 N m in front_right_hip, which no motion explains",
    "leave out; check for a loose contact", ("front_right_hip",), (Span(3, 5, "front_right_hip"),),
)  # fmt: skip
DEGREES = Finding("unit", REJECTED, "joint_position", "more than two turns: degrees", "convert to radians")
SIGN = Finding("sign", SUSPICIOUS, "contact_wrench_local", "the total is negative", "reverse")
WEIGHT = Finding("weight", NOTE, "contact_wrench_local", "contacts carry 21.36 kg, the URDF weighs 20.8 kg", "none")


def checked(name: str, *findings: Finding) -> Checked:
    time = np.arange(20) * 0.01
    log = Log(f"{name}.npz", time, ("knee",), np.zeros((20, 1)))
    return Checked(log, log, findings, (Skipped("forces against the model", "no robot (--urdf)"),))


def text(logs: list[Checked], width: int = 100) -> str:
    return " ".join(" ".join(check_lines(logs, (), width)).split())


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("count", [1, 2, 5, 60])
def test_any_number_of_logs_and_findings_fits_on_a_screen(count: int, width: int) -> None:
    fields = [f"field_{k}" for k in range(6)]
    found = [replace(SPIKE, field=field) for field in fields] + [replace(SIGN, field=field) for field in fields]
    logs = [checked(f"walk_{k}", *found[: 3 * k % 13], WEIGHT) for k in range(count)]
    lines = check_lines(logs, ("found.json", None), width)
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= width
    assert lines[-1] == "written to    found.json"


def test_a_terminal_of_a_few_columns_gets_all_the_same() -> None:
    for width in (1, 14, 15, 30):
        for count in (0, 1, 2, 30):
            for findings in ((), (SPIKE, SIGN)):
                assert check_lines([checked("walk", *findings)] * count, (), width)


def test_the_verdict_comes_first_and_the_worst_finding_next_with_what_to_do() -> None:
    logs = [checked("clean", WEIGHT), checked("spiked", SPIKE, SIGN), checked("degrees", DEGREES)]
    assert text(logs).startswith(
        "2 of 3 logs are usable (1 without some samples); findings in 2. "
        "rejected joint_position (unit) in degrees.npz: more than two turns: degrees do: convert to radians "
        "rejected joint_torque (spike) in spiked.npz: excursions of 200 N m"
    )
    rows = [line.split() for line in check_lines(logs, (), 100) if re.match(r"\w+\.npz ", line)]
    assert rows == [
        ["degrees.npz", "no", "1", "20", "0.19"],
        ["spiked.npz", "without", "3", "samples", "1", "1", "20", "0.19"],
        ["clean.npz", "yes", "1", "20", "0.19"],
    ]


def test_one_log_is_named_with_its_verdict() -> None:
    assert text([checked("walk", WEIGHT)]).startswith("walk.npz: 20 samples, 0.19 s: usable; no mistake found")
    assert text([checked("walk", SIGN)]).startswith("walk.npz: 20 samples, 0.19 s: usable suspicious ")
    assert text([checked("walk", DEGREES)]).startswith("walk.npz: 20 samples, 0.19 s: not usable: joint_position: unit")
    assert "not checked 1 check: forces against the model (no robot (--urdf))" in text([checked("walk")])


@pytest.mark.parametrize("width", [60, 100])
def test_every_finding_is_shown_or_counted(width: int) -> None:
    names = [f"kind_{k}" for k in range(12)]
    severities = [REJECTED, SUSPICIOUS, NOTE]
    logs = [checked("walk", *(replace(SPIKE, name=name, severity=s) for s in severities for name in names))]
    lines = check_lines(logs, (), width)
    shown = sum(line.startswith((*severities,)) for line in lines)
    (rest,) = (line for line in lines if line.endswith("--verbose"))
    counted = {s: int(n) for n, s in re.findall(rf"(\d+) ({'|'.join(severities)})", rest)}
    assert rest.startswith("and ")
    assert shown + sum(counted.values()) == 36
    assert counted == {REJECTED: 12 - shown, SUSPICIOUS: 12, NOTE: 12}, "the most severe are shown"


def test_what_several_logs_share_is_said_once_and_where_all_of_it_is() -> None:
    logs = [checked(f"walk_{k}", SPIKE) for k in range(4)]
    said = text(logs)
    assert said.count("leave out; check for a loose contact") == 1
    assert "(spike) in walk_0.npz, also walk_1.npz and 2 more: excursions" in said
    assert "full text: --verbose" in said
    again = [replace(SPIKE, field=field) for field in ("joint_position", "joint_torque")]
    assert "joint_position, joint_torque (spike): excursions" in text([checked("walk", *again)])


def test_a_terminal_gets_plain_lines_of_its_width(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.chdir(tmp_path)
    write_log(checked("walk").log, "walk.npz")
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("NO_COLOR", "1")
    for width in (60, 90):
        monkeypatch.setenv("COLUMNS", str(width))
        for command in (["check"], ["init", str(DEMO / "quadruped.urdf"), f"--output={width}.yaml"]):
            screen = Terminal()
            monkeypatch.setattr(sys, "stdout", screen)
            assert main([*command, "walk.npz"]) == 0
            lines = screen.getvalue().splitlines()
            assert "\x1b" not in screen.getvalue()
            assert width - 15 < max(map(len, lines)) <= width


def test_quiet_prints_nothing_and_ends_with_the_same_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = checked("walk").log
    write_log(log, tmp_path / "usable.npz")
    write_log(log.select(np.arange(2)), tmp_path / "short.npz")
    for name, status in (("usable", 0), ("short", 1)):
        for option in ("--quiet", "--verbose", None):
            assert main(["check", str(tmp_path / f"{name}.npz"), *([option] if option else [])]) == status
            printed = capsys.readouterr()
            assert printed.err == ""
            assert (printed.out == "") == (option == "--quiet")
            assert ("verdict       " in printed.out) == (option == "--verbose")
