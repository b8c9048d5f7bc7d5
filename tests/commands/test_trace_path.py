"""What runs between a log and its parameters, counted: the library's path passes no command and no settings file."""

from __future__ import annotations

from script_calls import script


def test_the_librarys_path_from_a_log_to_parameters_passes_no_command_and_no_report() -> None:
    trace_path = script("trace_path")
    trace_path.import_everything()
    demo = trace_path.PACKAGE / "demo" / "quadruped.yaml"
    trace = trace_path.Trace().run(lambda: trace_path.library_path(demo)).from_log()
    packages = list(dict.fromkeys(call[0].split("/")[0] for call in trace.calls))
    assert packages[0] == "logs"
    assert {"regressor", "sensing", "problem", "estimators"} < set(packages)
    assert not {"commands", "config", "fitting", "report", "simulation"} & set(packages)
    assert trace.calls[-1][0].startswith("estimators/") or trace.calls[-1][0].startswith("problem/")
    assert any("read_log" in line for line in trace.functions())
