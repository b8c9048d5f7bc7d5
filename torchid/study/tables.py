"""The study's tables, for the terminal and for text files."""

from __future__ import annotations

from rich.table import Table

from torchid.report.metrics import GROUPS
from torchid.study.findings import findings
from torchid.study.results import Results

_COLUMNS = {
    "joint torque\n[N m]": ("joint_torque", "joint_torque/relative"),
    "base force\n[N]": ("base_force", "base_force/relative"),
    "base force, of\nits variation": (None, "base_force/variation"),
    "base moment\n[N m]": ("base_moment", "base_moment/relative"),
    "projected\n[N, N m]": ("nullspace", "nullspace/relative"),
}


def error_table(results: Results, condition: str, training: str, against: str = "exact") -> Table:
    """Errors on the unseen log, Fig. 6: medians of rms and share of the measured, and that share's range in %."""
    compared = "the truth" if against == "exact" else "what its sensors say"
    title = f"Unseen squat against {compared}; sensors: {condition}; fitted on {training}"
    table = Table(title=title, title_justify="left")
    table.add_column("", no_wrap=True)
    for heading in _COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for sensors in results.sensors:
        cells = []
        for absolute, relative in _COLUMNS.values():
            lines = []
            if absolute is not None:
                lines.append(f"{results.spread(condition, training, sensors, absolute, against).median:.3g}")
            share = results.spread(condition, training, sensors, relative, against)
            lines.append(f"{100 * share.median:.2g} %")
            if share.greatest > share.least:
                lines.append(f"{100 * share.least:.2g}–{100 * share.greatest:.2g}")
            cells.append("\n".join(lines))
        table.add_row(sensors, *cells, end_section=True)
    return table


def summary_table(results: Results, training: str) -> Table:
    """Median error of every sensor set under every condition, as a share of the measured."""
    title = f"Error [%] of joint torque, base force, base moment, projected force; fitted on {training}"
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for condition in results.conditions:
        table.add_column(condition, justify="right")
    for sensors in results.sensors:
        cells = []
        for condition in results.conditions:
            medians = [results.spread(condition, training, sensors, f"{group}/relative").median for group in GROUPS]
            cells.append("\n".join(f"{100 * median:.2g}" for median in medians))
        table.add_row(sensors, *cells, end_section=True)
    return table


def findings_table(results: Results) -> Table:
    """Which of the paper's findings hold, by condition and training logs."""
    table = Table(title="Findings of the paper: (1) full (2) contacts (3) joints", title_justify="left")
    for heading in ("sensors", "fitted on", "", "holds", "median error"):
        table.add_column(heading)
    for condition in results.conditions:
        for training in results.trainings:
            for finding in findings(results, condition, training):
                first = finding.number == 1
                table.add_row(
                    condition if first else "",
                    training if first else "",
                    f"({finding.number})",
                    "yes" if finding.holds else "no",
                    finding.why,
                    end_section=finding.number == 3,
                )
    return table


def rank_table(results: Results) -> Table:
    """Samples and independent combinations per contact state, alone and together, by sensor set."""
    sets = list(dict.fromkeys(ranks.sensors for ranks in results.ranks))
    table = Table(title="Independent combinations of parameters, by contact state", title_justify="left")
    for heading in ("fitted on", "in contact", "samples", *sets):
        table.add_column(heading, justify="left" if heading in ("fitted on", "in contact") else "right")
    for training in results.trainings:
        of = {ranks.sensors: ranks.states for ranks in results.ranks if ranks.training == training}
        for number, state in enumerate(of[sets[0]]):
            ranks_of_state = [str(next((s.rank for s in of[name] if s.name == state.name), 0)) for name in sets]
            last = number == len(of[sets[0]]) - 1
            table.add_row(
                training if number == 0 else "", state.name, str(state.samples), *ranks_of_state, end_section=last
            )
    return table
