"""What an experiment file asks `torchid analyze`, by the robot's names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from torchid.analysis.candidates import Candidate, candidates
from torchid.errors import ConfigError, SensorError, UnknownNameError
from torchid.problem import Samples
from torchid.problem.chunks import by_state
from torchid.problem.plan import State
from torchid.run.experiment import Scene
from torchid.sensing import SensorSet


@dataclass(frozen=True)
class Asked:
    """Candidates, those to keep and to exclude, the set to check (None: none), and sets to compare by name."""

    scene: Scene
    source: object
    offered: tuple[Candidate, ...]
    keep: frozenset[Candidate]
    exclude: frozenset[Candidate]
    proposal: SensorSet | None
    named: Mapping[str, SensorSet]


def asked(scene: Scene, source: object = "experiment") -> Asked:
    """Look everything up.

    Raises:
        InputError: a name that nothing answers to, or that is taken.
    """
    settings, config = scene.config.analysis, scene.config
    wanted = settings.candidates
    with placed(source):
        offered = candidates(
            scene.robot, scene.contacts, wanted.joint_torques, wanted.contacts, settings.costs, wanted.ft_sensors
        )
    proposal = None if config.sensors.empty else scene.sensors_of(config.sensors, source)
    keep, exclude = (_chosen(getattr(settings, field), field, offered, source) for field in ("keep", "exclude"))
    return Asked(scene, source, offered, keep, exclude, proposal, _named_sets(scene, proposal, source))


@contextmanager
def placed(source: object, field: str = "analysis", instead_of: str = "") -> Iterator[None]:
    """Complaints name the experiment file and the place in it.

    Args:
        source: the file.
        field: put before the place that a complaint names, or instead of its beginning.
        instead_of: that beginning.
    """
    try:
        yield
    except UnknownNameError as error:
        raise UnknownNameError(source, _place(field, instead_of, error), error.name, error.valid) from error
    except SensorError as error:
        raise SensorError(source, _place(field, instead_of, error), error.found, error.accepted) from error


def scenarios(scene: Scene, train: Sequence[Samples], source: object = "experiment") -> dict[str, tuple[State, ...]]:
    """Contact states by scenario; of logs, most frequent first.

    Raises:
        UnknownNameError: a frame that is no contact.
    """
    frames = [contact.frame for contact in scene.contacts]
    wanted = scene.config.analysis.scenarios
    if wanted is None:
        seen: Counter[State] = Counter()
        for samples in train:
            for state, index in by_state(samples):
                seen[state] += len(samples[index])
        most_first = tuple(state for state, _ in seen.most_common())
        return {"logs": most_first} if seen else {"all_contacts": ((True,) * len(frames),)}
    out = {}
    for name, states in wanted.items():
        for frame in (frame for state in states for frame in state):
            if frame not in frames:
                raise UnknownNameError(source, f"analysis.scenarios.{name}", frame, frames)
        out[name] = tuple(dict.fromkeys(tuple(frame in state for frame in frames) for state in states))
    return out


def _place(field: str, instead_of: str, error: UnknownNameError | SensorError) -> str:
    return error.field.replace(instead_of, field, 1) if instead_of else f"{field}.{error.field}"


def _chosen(names: Sequence[str], field: str, offered: Sequence[Candidate], source: object) -> frozenset[Candidate]:
    by_name: dict[str, list[Candidate]] = {}
    for candidate in offered:
        by_name.setdefault(candidate.name, []).append(candidate)
    for name in names:
        if name not in by_name:
            raise UnknownNameError(source, f"analysis.{field}", name, by_name)
        if len(by_name[name]) > 1:
            found = f"'{name}', the name of several sensors: joint, contact or fixed joint"
            raise ConfigError(source, f"analysis.{field}", found, "a name that only one sensor has")
    return frozenset(by_name[name][0] for name in names)


def _named_sets(scene: Scene, proposal: SensorSet | None, source: object) -> dict[str, SensorSet]:
    """The proposed set and those that the file compares."""
    sets = {} if proposal is None else {"proposed": proposal}
    for name, choice in scene.config.analysis.compare.items():
        field = f"analysis.compare.{name}"
        if name in sets:
            raise ConfigError(source, field, "the name of what stands under sensors", "another name")
        with placed(source, field, instead_of="sensors"):
            sets[name] = scene.sensors_of(choice, source)
    return sets
