"""Which links of a robot touch the ground, as `torchid init` guesses from names and collision shapes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torchid.logs.file_samples import stated_names
from torchid.logs.name_matching import within
from torchid.robot import CollisionShapes, Robot

_FEET = (r"foot|feet", r"sole", r"ankle_roll|ankle_flexion", r"toe|ankle|paw|hoof")
"""Words in names of links that touch the ground, the surest first."""

_ON_FEET = r"sensor|imu|camera|bumper|laser"
_IN_LIMBS = r"(?<![a-z])ft(?![a-z])"
_NAMED = r"foot|feet|sole"


@dataclass(frozen=True)
class GuessedContact:
    """A frame that touches the ground, and the type of its contact, as an experiment file has them."""

    frame: str
    type: str


def stated_contacts(sample: Any, robot: Robot) -> list[str]:
    """Contacts that a log in the format names, as far as the robot has them."""
    names = stated_names(sample, "contact_names")
    names += [name.split(".")[1] for name in sample if re.fullmatch(r"contact_active\.[^.]+", name)]
    return [name for name in dict.fromkeys(names) if name in robot.links]


def guess_contacts(robot: Robot, stated: Sequence[str], texts: Sequence[str]) -> list[GuessedContact]:
    """Feet: links of outermost bodies with the surest word in their names, one of each body, spheres first.

    Those that the log names, in one of its texts, count before all others.
    """
    shapes = CollisionShapes(robot)
    inner = {body.parent for body in robot.bodies}
    texts = [text.lower() for text in texts if not re.search(_IN_LIMBS, text, re.IGNORECASE)]
    named = [name for name in robot.links if any(within(name.lower()).search(text) for text in texts)]
    frames = list(stated)
    for words, links in ((_NAMED, named), *((words, list(robot.links)) for words in _FEET)) if not frames else ():
        by_body: dict[int, list[str]] = {}
        for name in links:
            body, is_foot = robot.links[name][0], re.search(words, name, re.IGNORECASE)
            if body and body not in inner and is_foot and not re.search(_ON_FEET, name, re.IGNORECASE):
                by_body.setdefault(body, []).append(name)
        frames = [
            min(names, key=lambda name: (shapes.about(name) is None, "sole" not in name.lower(), len(name)))
            for names in by_body.values()
        ]
        if len(frames) > 1:
            break
        frames = []
    flat = len(frames) < 3
    return [GuessedContact(x, "flat" if flat and shapes.about(x) is None else "point") for x in frames]
