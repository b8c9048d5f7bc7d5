"""Whether a log has what the sensors of a fit need: their readings, and contacts that leave the base its six rows."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import torch

from torchid.errors import InputError
from torchid.log_checks.findings import REJECTED, Finding, refused
from torchid.parallel import one_thread
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import subsample_states
from torchid.problem.contact_state import state_name
from torchid.problem.samples import require_forces
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet
from torchid.sensing.projection import base_rank, base_singular_values

#: Samples of each contact state whose rank is counted, and states that a finding names.
_SAMPLES, _NAMED = 60, 3


def check_required(
    samples: Sequence[Samples], robot: Robot, contacts: Sequence[Contact], required: SensorSet, goes_on: bool
) -> Iterator[Finding]:
    """Findings about a log that a fit would refuse.

    Args:
        samples: some of the log.
        robot: the robot.
        contacts: of it.
        required: sensors of the fit.
        goes_on: whether it goes on where the base is lost.
    """
    try:
        for part in samples:
            require_forces(part, robot, contacts, required)
    except InputError as error:
        yield refused(error)
    if not robot.fixed_base and not goes_on:
        yield from _lost_base(samples, RowBuilder(robot, contacts, required))


@one_thread()
@torch.no_grad()
def _lost_base(samples: Sequence[Samples], builder: RowBuilder) -> Iterator[Finding]:
    """A finding about contact states in which rank(S_b V_x) is below 6 in most samples."""
    ranks, counts = defaultdict[str, list[torch.Tensor]](list), Counter[str]()
    for part, state, weight in subsample_states(samples, _SAMPLES):
        name = state_name(builder.contacts, state)
        counts[name] += round(weight * len(part))
        for _, V in builder.null_space_bases(state, builder.kinematics(part)):
            ranks[name].append(base_rank(base_singular_values(V)))
    usual = {name: int(torch.cat(ranks[name]).median()) for name, _ in counts.most_common()}
    if lost := {name: rank for name, rank in usual.items() if rank < 6}:
        named = "; ".join(f"{name}: rank {rank} of 6" for name, rank in list(lost.items())[:_NAMED])
        more = f"; and {len(lost) - _NAMED} contact states more" if len(lost) > _NAMED else ""
        text = f"the base is lost, rank(S_b V_x) < 6, in contact with {named}{more}"
        advice = "measure more (torchid analyze finds what suffices), leave such samples out, or set"
        advice += " sensors.on_base_lost: warn"
        yield Finding("does not fit", REJECTED, "sensors", text, advice)
