"""Looks at a study in words: how many, when, with which seeds, at which level."""

from experiments.looks import Design, Look, Looks, Question
from report.words import look_sentences

QUESTION = Question("final", None, None, 1000)


def look(level, planned=False, **seeds):
    return Look("2026-11-22 10:00:00", QUESTION, seeds, {}, {}, level, planned)


def test_nobody_has_looked():
    assert look_sentences(Looks()) == []


def test_each_look_has_a_line():
    assert look_sentences(Looks((look(0.045, a=1, b=1),))) == [
        "These runs have been looked at once.",
        "2026-11-22: seed 1000; claims at 4.5 %.",
    ]
    taken = (look(0.045, a=5, b=5), look(0.0025, a=10, b=5, c=10))
    assert look_sentences(Looks(taken)) == [
        "These runs have been looked at twice.",
        "2026-11-22: seeds 1000 to 1004; claims at 4.5 %.",
        "2026-11-22: b, seeds 1000 to 1004; a and c, seeds 1000 to 1009; claims at 0.25 %.",
    ]


def test_looks_that_were_settled_are_named():
    design = Design(QUESTION, (5, 8, 12), {}, 0)
    taken = tuple(look(0.015, planned=True, a=size) for size in (5, 8, 12))
    lines = look_sentences(Looks(taken, design))
    assert lines[0] == "These runs have been looked at 3 times."
    assert lines[1] == "Fixed before the first of them: looks at 5, 8 and 12 seeds."
    assert len(lines) == 5
