"""What `torchid identify` says on one screen."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import shortened_demo
from repository import DEMO

from torchid.cli import _options, main
from torchid.commands.answer import times_smaller
from torchid.commands.identify import identify
from torchid.commands.run_folder import Identification
from torchid.config import load_config
from torchid.estimators import SgdEstimate
from torchid.estimators.least_squares import COMBINED, IDENTIFIED, ConstrainedEstimate
from torchid.fitting.noise import unexplained_torques
from torchid.parameters import COULOMB, FRICTION, INERTIAL, PER_BODY
from torchid.problem import Metrics
from torchid.problem.metrics import DECISIVE_GROUPS, LIMB_GROUPS, WHITENED, WorseThanNominal
from torchid.report.tables import LINES
from torchid.sensing import named_sensors
from torchid.terminal.identification import answer_lines

UNPHYSICAL = "ignore:identified.urdf:torchid.errors.TorchidWarning"
WIDTHS = (60, 80, 100, 120)


def run_demo(folder: Path, *settings: str) -> Identification:
    more = [*settings, f"output={folder / 'run'}"]
    return identify(load_config(DEMO / "quadruped.yaml", more), False)


@pytest.fixture(scope="module")
def consistent(tmp_path_factory: pytest.TempPathFactory) -> Identification:
    return run_demo(tmp_path_factory.mktemp("consistent"))


@pytest.fixture(scope="module")
def free(tmp_path_factory: pytest.TempPathFactory) -> Identification:
    closest = "estimator={name: least_squares, ridge: 0.01, friction: false}"
    with pytest.warns(match="identified.urdf"):
        return run_demo(tmp_path_factory.mktemp("free"), "logs.test=[]", closest)


def text(run: Identification, width: int = 100) -> str:
    return "\n".join(answer_lines(run, width))


@pytest.mark.parametrize("width", WIDTHS)
def test_it_fits_on_a_screen_of_any_width(consistent: Identification, free: Identification, width: int) -> None:
    for run in (consistent, free):
        lines = answer_lines(run, width)
        assert len(lines) <= LINES
        assert not any(line.startswith("attention") and line.endswith("...") for line in lines)
        paths = [line for line in lines if "written to" in line or str(run.experiment.config.output.name) in line]
        assert max(len(line) for line in lines if line not in paths) <= width


def test_the_errors_on_unseen_motion_come_first_with_the_noise(consistent: Identification) -> None:
    said = text(consistent)
    assert said.startswith("Much better than the URDF on unseen motion (sway_test.npz)")
    pair = consistent.metrics["test"]
    for group in (x for x in DECISIVE_GROUPS if x not in LIMB_GROUPS):  # this robot has none
        numbers = (pair.nominal.rms[group], pair.identified.rms[group], pair.identified.noise[group])
        assert all(x is not None for x in numbers)
        assert " ".join(f"{x:.4g}" for x in numbers) in " ".join(said.split())
    assert "total mass" in said
    assert f"{consistent.mass.value:.3f} ± " in said
    assert str(consistent.experiment.config.output) in " ".join(said.split("\n")[-1:])


@pytest.mark.parametrize(
    ("least", "most", "said"),
    [
        (0.071, 0.25, "4 to 14 times smaller"),
        (0.5, 0.5, "2 times smaller"),
        (0.0, 0.96, "1.04 to over 1000 times smaller"),
        (0.5, 1.25, "1.25 times larger to 2 times smaller"),
        (1.0, 3.0, "1 to 3 times larger"),
    ],
)
def test_errors_are_compared_as_times_smaller(least: float, most: float, said: str) -> None:
    assert times_smaller(least, most) == said


def test_joints_that_rest_are_named_where_forces_are_not_explained(consistent: Identification) -> None:
    assert consistent.resting == {}
    resting = replace(consistent, resting={"front_left_knee": 1.0, "rear_left_hip": 0.31})
    unexplained = replace(resting, misfit=replace(resting.misfit, lack_of_fit=9.0))
    said = " ".join(text(unexplained).split())
    assert "as joints rest (front_left_knee 100 %, rear_left_hip 31 %). Set actuators.stiction=true." in said
    assert "stiction" not in text(resting)


def test_joints_that_never_move_are_named_where_their_torque_counts_as_unmeasured(consistent: Identification) -> None:
    config = consistent.experiment.config
    taken = replace(config, actuators=replace(config.actuators, stiction=True))
    run = replace(consistent, experiment=replace(consistent.experiment, config=taken))
    assert "stiction" not in text(replace(run, resting={"rear_left_hip": 0.9}))
    said = " ".join(text(replace(run, resting={"front_left_knee": 1.0, "rear_left_hip": 0.9})).split())
    assert "No friction is identified of front_left_knee: they always rest, or almost," in said


def test_errors_on_motion_that_was_fitted_are_not_those_of_unseen_motion(consistent: Identification) -> None:
    config = consistent.experiment.config
    fitted = replace(config, logs=replace(config.logs, test=config.logs.train))
    said = text(replace(consistent, experiment=replace(consistent.experiment, config=fitted)))
    assert said.startswith("Much better than the URDF on training motion (sway_train.npz)")


def test_logs_in_which_nothing_moves_judge_neither_inertia_nor_friction(
    consistent: Identification, free: Identification
) -> None:
    assert list(consistent.at_rest) == list(free.at_rest) == []
    for run, rests, where in (
        (consistent, "test", "the test logs (sway_test.npz)"),
        (free, "train", "5 held-out blocks of the training logs"),
    ):
        said = " ".join(text(replace(run, at_rest=[rests])).split())
        assert said.startswith(f"Nothing moves in {where}: inertia and friction are not judged. ")
        assert "Compared with the URDF, the error is " in said
        assert "etter than the URDF" not in said
    assert "Nothing moves" not in text(replace(consistent, at_rest=["train"]))  # the test moves


def test_without_test_logs_blocks_left_out_are_judged_and_the_text_says_so(free: Identification) -> None:
    first = text(free).split("rms error of")[0].replace("\n", " ")
    assert "5 held-out blocks of the training logs" in first
    assert first.startswith("Mixed, compared with the URDF on ")
    assert "joints and base axes, worse in " in first
    assert free.validation is not None
    assert f"{free.validation.identified.rms['joint_torque']:.4g}" in text(free)


def test_projected_forces_are_shown_where_no_joint_or_base_force_can_be(consistent: Identification) -> None:
    def without_others(metrics: Metrics) -> Metrics:
        return replace(metrics, rms={name: metrics.rms[name] for name in ("nullspace", WHITENED)})

    pair = consistent.metrics["test"]
    fewer = pair._replace(nominal=without_others(pair.nominal), identified=without_others(pair.identified))
    said = text(replace(consistent, metrics=consistent.metrics | {"test": fewer}))
    assert f"{pair.identified.rms['nullspace']:.4g}" in said.split("projected force [N, N m]")[1].split("\n")[0]
    assert "base force" not in said
    assert "projected" not in text(consistent)


def test_bodies_that_cannot_exist_are_counted_with_what_to_do(consistent: Identification, free: Identification) -> None:
    bodies = {violation.body for violation in free.violations}
    assert len(bodies) > 2
    advice = "simulators refuse them. Use estimator.name=consistent"
    assert f"{len(bodies)} of 13 not physically consistent; {advice}" in " ".join(text(free).split())
    assert "bodies        all 13 physically consistent\n" in text(consistent)
    assert "not physically consistent" not in text(consistent)


def test_a_file_that_simulators_refuse_is_not_said_to_be_taken(consistent: Identification) -> None:
    phi = consistent.phi.copy()
    phi[3, 1:10] = 0.0  # a point mass at the axis that moves it, which breaks no condition
    said = " ".join(text(replace(consistent, estimate=replace(consistent.estimate, phi=phi.flatten()))).split())
    assert "all 13 physically consistent, but MuJoCo refuses the file: " in said


def test_a_total_mass_that_contradicts_the_urdf_needs_attention(consistent: Identification) -> None:
    assert "Weigh the robot" not in text(consistent)
    light = replace(consistent, mass=replace(consistent.mass, value=0.4 * consistent.mass.nominal))
    assert "attention     The total mass is 0.4 times the URDF's. Weigh the robot" in text(light, 400)
    vague = replace(light, mass=replace(light.mass, standard_error=0.4 * consistent.mass.nominal))
    assert "times the URDF's" not in text(vague)


def test_bodies_that_a_weak_prior_lets_go_far_from_the_urdf_are_said_to_weigh_so(consistent: Identification) -> None:
    unknown, nominal = replace(consistent.mass, standard_error=np.inf), consistent.mass.nominal
    near, far = (text(replace(consistent, mass=replace(unknown, value=x * nominal)), 400) for x in (1.1, 5.0))
    assert "attention     These data do not determine the total mass. Weigh the robot: estimator.total_mass" in near
    assert "(the fit: 104.000 kg, URDF: 20.800 kg)" in far


@pytest.mark.parametrize(("variation", "of_weight", "told"), [(1.4, 0.5, True), (1.4, 0.01, False), (0.5, 0.5, False)])
def test_a_base_force_that_a_constant_would_predict_as_well_is_not_explained(
    consistent: Identification, variation: float, of_weight: float, told: bool
) -> None:
    pair = consistent.metrics["test"]
    relative = {**pair.identified.relative, "base_force": of_weight}
    found = replace(pair.identified, base_force_of_variation=variation, relative=relative)
    said = text(replace(consistent, metrics=consistent.metrics | {"test": pair._replace(identified=found)}), 400)
    error = "The error of the base force is 1.4 times the variation of its measured value"
    assert (f"attention     {error}. Check frames" in said) is told
    assert ("model does not explain these forces" in said.split("rms error")[0]) is told


@pytest.mark.parametrize(("share", "told"), [(5e-4, True), (2e-3, False)])
def test_forces_that_the_file_itself_predicts_are_said_to_be_computed(
    consistent: Identification, share: float, told: bool
) -> None:
    pair = consistent.metrics["test"]
    near = replace(pair.nominal, relative=dict.fromkeys(pair.nominal.relative, share))
    metrics = consistent.metrics | {"test": pair._replace(nominal=near)}
    assert ("Are they computed from it" in text(replace(consistent, metrics=metrics), 200)) == told


def test_projected_forces_that_no_bodies_would_predict_as_well_are_not_explained(consistent: Identification) -> None:
    pair = consistent.metrics["test"]
    found = replace(pair.identified, relative={**pair.identified.relative, "nullspace": 1.31})
    said = text(replace(consistent, metrics=consistent.metrics | {"test": pair._replace(identified=found)}), 400)
    error = "The error of the projected force is 1.3 times the measured value"
    assert f"{error}. Check signs, units and order of joints: torchid check." in said
    assert "the measured value" not in text(consistent, 400)


@pytest.mark.parametrize(
    ("group", "share", "noise", "in_air", "read", "told"),
    [
        ("joint_torque", 0.7, None, False, "full", True),
        ("nullspace", 0.7, None, True, "full", True),
        ("joint_torque", 0.7, None, True, "full", False),
        ("joint_torque", 0.4, None, False, "full", False),
        ("joint_torque", 0.7, 1.9, False, "full", False),
        ("base_moment", 0.7, None, False, "full", False),
        ("nullspace", 0.7, None, False, "joints", True),
        ("joint_torque", 0.7, None, False, "joints", False),
        ("nullspace", 0.7, None, False, "contacts", False),
    ],
)
def test_a_fit_that_leaves_most_of_the_torques_is_not_explained_by_other_forces(
    consistent: Identification, group: str, share: float, noise: float | None, in_air: bool, read: str, told: bool
) -> None:
    """By `noise` of the readings that is about as large it may be; limbs in the air are no measure of all torques.

    Nor is what the sensors of the fit do not read: friction, for contact sensors.
    """
    fitted = consistent.metrics["train"].identified
    errors: dict[str, Any] = {"rms": {**fitted.rms, group: 2.0}, "relative": {**fitted.relative, group: share}}
    found = replace(fitted, **errors, noise={**fitted.noise, group: noise}, limbs_in_air=in_air)
    experiment = consistent.experiment
    sensors = named_sensors(read, experiment.robot.n, len(experiment.contacts))
    assert unexplained_torques(found, sensors) == "the fit does not explain 70 % of the joint torques" * told


def test_bodies_that_are_heavy_without_data_are_named_together_with_a_ridge_that_was_not_tried(
    consistent: Identification,
) -> None:
    robot, estimate = consistent.experiment.robot, consistent.estimate
    phi, known = estimate.phi.copy(), estimate.identifiable.copy()
    known[PER_BODY : 3 * PER_BODY] = False
    phi[[PER_BODY, 2 * PER_BODY]] = [5.0, 3.0] * robot.nominal[[1, 2], 0]
    said = text(replace(consistent, estimate=replace(estimate, phi=phi, identifiable=known)), 400)
    names, ridge = robot.body_names, consistent.experiment.config.estimator.ridge
    named = f"{names[1]} 5 times, {names[2]} 3 times the URDF's"
    assert f"attention     Masses that the data do not determine are large: {named}. Raise" in said
    assert f"Raise estimator.ridge above {ridge}." in said


@pytest.mark.parametrize(("errors", "told"), [(-5.0, True), (-3.0, False)])
def test_friction_that_drives_a_joint_beyond_its_errors_points_to_a_reversed_torque(
    consistent: Identification, errors: float, told: bool
) -> None:
    phi, at = consistent.estimate.phi.copy(), 2 * PER_BODY + COULOMB
    phi[at] = errors * consistent.estimate.standard_error[at]
    said = text(replace(consistent, estimate=replace(consistent.estimate, phi=phi)), 400)
    body = consistent.experiment.robot.bodies[2]
    assert body.joint is not None
    assert (f"The Coulomb friction of {body.joint.name} is negative: the torque is reversed" in said) is told


@pytest.mark.parametrize(("share", "unlike"), [(0.3, True), (0.6, False)])
def test_bodies_far_off_their_file_need_a_wider_prior_and_a_line_says_which(
    consistent: Identification, share: float, unlike: bool
) -> None:
    fitted = consistent.posterior
    light = fitted.posterior.nominal.copy()
    light.reshape(-1, PER_BODY)[:, INERTIAL] *= share
    wrong = replace(fitted, posterior=replace(fitted.posterior, nominal=light))
    said = text(replace(consistent, posterior=wrong), 400)
    assert "torchid sample --prior-error auto" in said
    assert str(wrong.nominal_error) in said
    assert ("does not explain these forces, or the file is of another robot" in said) is unlike
    assert "--prior-error" not in text(consistent, 400)


def test_a_rod_in_the_file_is_named_where_bodies_are_far_off_it(consistent: Identification) -> None:
    """A small error across a body without thickness is a large share: the file may be the robot's all the same."""
    fitted = consistent.posterior
    thin = fitted.posterior.nominal.copy()
    thin.reshape(-1, PER_BODY)[:, INERTIAL] *= 0.3
    thin.reshape(-1, PER_BODY)[2, INERTIAL] = [1.0, 0.0, 0.0, 0.1, 0.02, 0.0, 0.0, 0.02, 0.0, 0.0]
    wrong = replace(fitted, posterior=replace(fitted.posterior, nominal=thin))
    said = text(replace(consistent, posterior=wrong), 400)
    assert f"the file is of another robot, or it has rods or plates ({fitted.body_names[2]})." in said


def test_a_descent_that_ended_above_the_optimum_says_so(consistent: Identification) -> None:
    own = {x.name for x in fields(ConstrainedEstimate)}
    shared = {name: x for name, x in vars(consistent.estimate).items() if name in own}
    for excess, told in ((0.002, False), (0.29, True), (None, True)):
        descent = {"epochs": 9, "best_epoch": 9, "residual": None, "excess": excess}
        misfit = replace(consistent.misfit, residual=9.0)
        assert not misfit.explained
        said = text(replace(consistent, misfit=misfit, estimate=SgdEstimate(**shared | descent)), 400)
        assert ("Friction, compliance or contacts are missing" in said) is not told
        assert ("attention     Not converged" in said) is told
        assert ("Not converged: 29 % above the optimum" in said) is (excess == 0.29)


def test_intervals_that_count_noise_alone_say_so(consistent: Identification) -> None:
    assert consistent.estimate.block_error is not None
    assert "include noise only" not in text(consistent, 400)
    short = replace(consistent, samples=50, estimate=replace(consistent.estimate, block_error=None, oversampling=2.0))
    said = text(short, 400)
    assert "attention     95 % intervals include noise only, no model errors: 25 independent samples are" in said


def test_residuals_that_cannot_contradict_the_model_are_said_to_show_nothing(consistent: Identification) -> None:
    assert consistent.misfit.judged
    short = replace(consistent, misfit=replace(consistent.misfit, expected=None, lack_of_fit=None))
    said = text(short, 400)
    assert "attention     It is unknown whether the model explains these forces" in said
    assert "sensors.noise" in said


def test_errors_of_a_sensor_in_a_limb_are_shown_and_need_attention_where_they_exceed_its_readings(
    consistent: Identification,
) -> None:
    def with_limb(share: float) -> str:
        pair, limb = consistent.metrics["test"], {"ft_force": 100.0 * share}
        relative = pair.identified.relative | {"ft_force": share}
        found = replace(pair.identified, rms=pair.identified.rms | limb, relative=relative)
        nominal = replace(pair.nominal, rms=pair.nominal.rms | {"ft_force": 230.0})
        one = pair._replace(identified=found, nominal=nominal)
        return text(replace(consistent, metrics={**consistent.metrics, "test": one}), 400)

    assert "force in limbs [N]" not in text(consistent)
    assert "attention     The error of the force in limbs is 1.3 times the measured value" in with_limb(1.26)
    assert re.search(r"force in limbs \[N\] +230 +30", said := with_limb(0.3))
    assert "the measured value" not in said


def test_what_needs_attention_is_named_with_what_to_do(free: Identification) -> None:
    (line,) = [line for line in text(free, 400).splitlines() if line.startswith("attention     Friction, ")]
    assert line.count("most in joint_torque") == 1
    misfit = free.misfit
    several = replace(misfit, expected=0.4 * misfit.residual, lack_of_fit=3.0, share=0.1)
    for width in (80, 100):  # the reason and where it shows are within the lines that there are
        said = " ".join(text(replace(free, misfit=several), width).split())
        assert f"most in {misfit.groups[0].group} " in said
    worse = replace(free)
    worse.__dict__["worse"] = [WorseThanNominal("test logs", "joint_torque", 1.0, 2.0)]
    said = text(worse, 400)
    assert said.startswith("WORSE THAN URDF (URDF -> identified) on test logs: joint torque 1 -> 2 N m")
    assert said.index("attention     Do not use these parameters") < said.index("attention     Friction, ")


def test_the_bodies_that_changed_most_are_listed_in_the_robots_order(consistent: Identification) -> None:
    lines = answer_lines(consistent, 120)
    start = next(k for k, line in enumerate(lines) if line.startswith("body "))
    robot, phi = consistent.experiment.robot, consistent.phi
    rows = [line for line in lines[start + 1 :] if line.split()[0] in robot.body_names]
    names = [row.split()[0] for row in rows]
    assert len(names) >= 4
    assert names == [name for name in robot.body_names if name in names]
    moved = np.abs(phi[:, 0] - robot.nominal[:, 0])
    chosen = [robot.body_names.index(name) for name in names]
    assert moved[chosen].min() >= np.delete(moved, chosen).max()
    verdict = consistent.estimate.verdict.reshape(-1, PER_BODY)
    errors = consistent.estimate.standard_error.reshape(-1, PER_BODY)
    for row, body in zip(rows, chosen, strict=True):
        assert verdict[body, 0] == COMBINED
        assert re.search(rf"{phi[body, 0]:.3f} \+ +{robot.nominal[body, 0]:.3f}", row)
        known = [k for k in (10, 11) if verdict[body, k] == IDENTIFIED]
        for k in known:
            value, error = next(
                (float(x), float(e))
                for x, e in re.findall(r"([\d.]+) ± ([\d.]+)", row)
                if abs(float(x) - phi[body, k]) < errors[body, k]
            )
            assert value == pytest.approx(phi[body, k], abs=0.5 * errors[body, k])
            assert error == pytest.approx(errors[body, k], rel=0.1)
    assert f"and {13 - len(rows)} bodies with a smaller change of mass: --verbose" in "\n".join(lines)
    assert "+ identified only in sums with other bodies; ± 1 sigma" in lines


def test_friction_that_no_joint_shows_has_no_columns(consistent: Identification) -> None:
    observable = consistent.estimate.observable.reshape(-1, PER_BODY).copy()
    observable[:, FRICTION] = False
    unseen = replace(consistent, estimate=replace(consistent.estimate, observable=observable.ravel()))
    for run, shown in ((consistent, True), (unseen, False)):
        assert any("Coulomb" in line for line in answer_lines(run, 120)) == shown


def test_names_are_never_broken_however_narrow_the_terminal(consistent: Identification) -> None:
    for width in WIDTHS:
        lines = answer_lines(consistent, width)
        start = next(k for k, line in enumerate(lines) if line.startswith("body "))
        for line in lines[start + 1 : start + 4]:
            assert line.split()[0] in consistent.experiment.robot.body_names


@pytest.mark.filterwarnings(UNPHYSICAL)
def test_all_tables_are_printed_when_asked_for_and_nothing_when_asked_to_be_quiet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    printed, file = {}, str(shortened_demo(tmp_path / "demo", 300) / "quadruped.yaml")
    for option in ("--quiet", "--verbose", None):
        command = ["identify", file, f"output={tmp_path / str(option)}", "logs.test=[]"]
        assert main([*command, *([] if option is None else [option])]) == 0
        printed[option] = capsys.readouterr().out
    assert printed["--quiet"] == ""
    assert len(printed[None].splitlines()) <= LINES
    assert printed[None].splitlines()[-1] == f"written to    {tmp_path / 'None'}"
    titles = (
        "Contact states",
        "Information lost without",
        "Parameters:",
        "Noise that weights the rows",
        "condition ",
        "minimized ",
    )
    for title in titles:
        assert title in printed["--verbose"]
        assert title not in printed[None]
    assert printed["--verbose"].splitlines()[0] == printed[None].splitlines()[0]
    for names in (("--quiet", "-q"), ("--verbose", "-v")):
        one, other = (vars(_options(["identify", file, option])) for option in names)
        assert one == other != vars(_options(["identify", file]))
    with pytest.raises(SystemExit):
        main(["identify", file, "-q", "-v"])
