"""What an experiment file requests of `torchid analyze`, its names looked up."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from torchid.errors import ConfigError, SensorError, UnknownNameError
from torchid.fitting.experiment import RobotSetup
from torchid.sensing import SensorSet
from torchid.sensor_planning.observability import Candidate, candidates


@dataclass(frozen=True, kw_only=True)
class AnalysisRequest:
    """What an experiment file requests, its names looked up.

    Attributes:
        setup: robot, contacts and settings.
        candidates: sensors to choose from.
        keep: those that are there anyway.
        exclude: those that cannot be.
        proposed: the sensors of the file, None if it names none.
        compared: sensor sets to compare, by name.
    """

    setup: RobotSetup
    candidates: tuple[Candidate, ...]
    keep: frozenset[Candidate]
    exclude: frozenset[Candidate]
    proposed: SensorSet | None
    compared: Mapping[str, SensorSet]

    @classmethod
    def of(cls, setup: RobotSetup) -> AnalysisRequest:
        """The request of an experiment file. Raises InputError: a name that nothing has, or that is taken."""
        settings, config = setup.config.analysis, setup.config
        choice = settings.candidates
        with errors_at("analysis"):
            offered = candidates(
                robot=setup.robot,
                contacts=setup.contacts,
                joint_torques=choice.joint_torques,
                per=choice.contacts,
                costs=settings.costs,
                ft_sensors=choice.ft_sensors,
                normal_forces=choice.normal_forces,
            )
        proposed = None if config.sensors.empty else setup.sensors_of(config.sensors)
        return cls(
            setup=setup,
            candidates=offered,
            keep=_candidates_named(settings.keep, "keep", offered),
            exclude=_candidates_named(settings.exclude, "exclude", offered),
            proposed=proposed,
            compared=_sets_named(setup, proposed),
        )


@contextmanager
def errors_at(field: str, instead_of: str = "") -> Iterator[None]:
    """Let errors name the experiment file, and a field of it before theirs or instead of its beginning."""
    try:
        yield
    except UnknownNameError as error:
        raise UnknownNameError.at_field(_field_in_file(field, instead_of, error), error.name, error.valid) from error
    except SensorError as error:
        raise SensorError.at_field(_field_in_file(field, instead_of, error), error.found, error.accepted) from error


def _field_in_file(field: str, instead_of: str, error: UnknownNameError | SensorError) -> str:
    return error.field.replace(instead_of, field, 1) if instead_of else f"{field}.{error.field}"


def _candidates_named(names: Sequence[str], field: str, offered: Sequence[Candidate]) -> frozenset[Candidate]:
    by_name: dict[str, list[Candidate]] = {}
    for candidate in offered:
        by_name.setdefault(candidate.name, []).append(candidate)
    for name in names:
        if name not in by_name:
            raise UnknownNameError.at_field(f"analysis.{field}", name, by_name)
        if len(by_name[name]) > 1:
            found = f"'{name}', the name of several sensors: joint, contact or fixed joint"
            raise ConfigError.at_field(f"analysis.{field}", found, "a name that only one sensor has")
    return frozenset(by_name[name][0] for name in names)


def _sets_named(setup: RobotSetup, proposed: SensorSet | None) -> dict[str, SensorSet]:
    """The proposed set and those that the file compares."""
    sets = {} if proposed is None else {"proposed": proposed}
    for name, choice in setup.config.analysis.compare.items():
        field = f"analysis.compare.{name}"
        if name in sets:
            raise ConfigError.at_field(field, "the name of what stands under sensors", "another name")
        with errors_at(field, instead_of="sensors"):
            sets[name] = setup.sensors_of(choice)
    return sets
