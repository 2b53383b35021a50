"""Programs as people write them, and the faults that are planted in them: see ``planted.yml``."""

from pathlib import Path

import yaml

ASKED = yaml.safe_load(Path(__file__).with_suffix(".yml").read_text(encoding="utf-8"))
PROGRAMS, FAULTS = ASKED["programs"], ASKED["faults"]


def text_of(program: str, old: str = "", new: str = "") -> str:
    """The text of a program with one replacement, which must find its place."""
    _, text = PROGRAMS[program]
    assert not old or text.count(old) == 1, (program, old)
    return text.replace(old, new) if old else text
