"""What the checks of the training logs say of a fit that is doubtful, though a robot may have its parameters."""

from __future__ import annotations

from torchid.commands.plausibility import TrainingLogs
from torchid.commands.results import Identification
from torchid.errors import ImplausibleFitError
from torchid.fitting.misfit import unexplained_joints


def suspected_mistake(run: Identification, logs: TrainingLogs) -> str:
    """What the checks find in the training logs where a fit is doubtful, in words; "" where it is not, or they do not.

    A fit is doubtful if its bodies are far off the robot's file, or if it leaves a large part of a joint's torque:
    masses make up for an encoder that is off or in degrees, and noise that is estimated for a torque of another gear.

    Args:
        run: a finished run.
        logs: that it is of.

    Raises:
        ImplausibleFitError: forces that the model does not explain, with bodies far off the robot's file, of a log that
            the checks reject.
    """
    nominal, fitted = run.posterior.nominal_error, run.metrics["train"].identified
    is_far_off = nominal is not None and nominal.prior_is_narrow
    joints = unexplained_joints(fitted) if run.experiment.robot.fixed_base else []
    if not is_far_off and not joints:
        return ""
    log, finding = logs.finding or (None, None)
    if finding is None or not finding.whole:  # some samples are no reason for parameters
        return ""
    found = f"{log}: {finding.field}: {finding.found}"
    if is_far_off and not run.misfit.explained and finding.rejects_all:
        reason = f"{nominal}, and the model does not explain these forces"
        raise ImplausibleFitError.at_field("logs", f"{reason}; torchid check finds in {found}", finding.advice)
    return f"{found}; {finding.advice}"
