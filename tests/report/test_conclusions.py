"""What is said first of an environment, and all of its verdicts at a glance."""

from dataclasses import replace

import pytest

from report.conclusions import conclusion, pairs_both_ways
from report.terminal import says_more
from verdicts import FailureCount, Summary

MEANS = {"a": 100.0, "b": 90.0, "c": 80.0}


def place_of(made_up, verdicts, means=MEANS, medians=None, **changes):
    """Agents with such means, and such verdicts on the first of two against the second."""
    agents = []
    for name, mean in means.items():
        agent = made_up.agent(name, mean)
        median = mean if medians is None else medians[name]
        figures = [made_up.estimate(value) for value in (mean, median, mean)]
        agents.append(replace(agent, metric=Summary(*figures), steps_to_stay=None))
    pairs = tuple(made_up.pair(*names, verdict) for names, verdict in verdicts.items())
    return made_up.environment(agents, pairs=pairs, optimum=200.0, **changes)


def said(made_up, verdicts, means=MEANS, medians=None, metric="final", **changes):
    place = place_of(made_up, verdicts, means, medians, **changes)
    return conclusion(made_up.study(list(means), metric=metric), place)


FIGURE = "return of the final policy 100 [99.9, 100.2], score 1; the optimum is 200"
A, B, C = "100 [99.9, 100.2]", "90 [89.9, 90.2]", "80 [79.9, 80.2]"

LEADS = {
    "better than all": (("better", "better", "undecided"), f"a is best: {FIGURE}."),
    "not known of one": (
        ("better", "undecided", "better"),
        f"a is best: {FIGURE}; against c it is undecided.",
    ),
    "two of three": (
        ("equivalent", "better", "better"),
        f"a and b are best, and equivalent: {FIGURE}.",
    ),
    "all alike": (
        ("equivalent", "equivalent", "equivalent"),
        f"a, b and c are best, and equivalent: {FIGURE}.",
    ),
    "one of two": (
        ("undecided", "better", "better"),
        f"Best is a ({A}) or b ({B}): that is undecided; the optimum is 200.",
    ),
    "not the highest mean": (
        ("worse", "undecided", "better"),
        "b is best: return of the final policy 90 [89.9, 90.2], score 0.9; the optimum is 200.",
    ),
    "one of three": (
        ("undecided", "undecided", "equivalent"),
        f"Best is a ({A}), b ({B}) or c ({C}): that is undecided; the optimum is 200.",
    ),
    "a circle": (
        ("better", "worse", "better"),
        "No agent is best: for each of them there is another that is better.",
    ),
    "nothing": (
        ("undecided", "undecided", "undecided"),
        f"Undecided: 4 seeds decide nothing. a has the highest mean so far: {FIGURE}.",
    ),
}


@pytest.mark.parametrize("case", LEADS)
def test_the_first_line(made_up, case):
    verdicts, lead = LEADS[case]
    pairs = dict(zip([("a", "b"), ("a", "c"), ("b", "c")], verdicts, strict=True))
    assert said(made_up, pairs).lead == lead


FAILED = "3 of 20 runs of b failed"
FAILED_LEADS = {
    "equivalent": f"a and b are best, and equivalent in the typical run: {FIGURE}; {FAILED}.",
    "better": f"a is best: {FIGURE}.",
    "worse": f"b is best: return of the final policy {B}, score 0.9; the optimum is 200; {FAILED}.",
    "undecided": f"Undecided: 4 seeds decide nothing. a has the highest mean so far: {FIGURE}.",
}


@pytest.mark.parametrize("verdict", FAILED_LEADS)
def test_the_first_line_says_whose_runs_failed_of_those_that_it_calls_best(made_up, verdict):
    failures = {"a": FailureCount(0, 20, 0.2), "b": FailureCount(3, 20, 0.4)}
    found = said(made_up, {("a", "b"): verdict}, {"a": 100.0, "b": 90.0}, failures=failures)
    assert found.lead == FAILED_LEADS[verdict]
    assert found.failed.startswith(FAILED)


def test_one_agent_has_no_rival(made_up):
    assert said(made_up, {}, {"a": 100.0}).lead == f"a: {FIGURE}."


def test_many_that_may_be_best_are_named_without_figures(made_up):
    means = {name: 100.0 - place for place, name in enumerate("abcde")}
    verdicts = {("a", "e"): "better"}
    lead = said(made_up, verdicts, means).lead
    assert lead == "Best is one of a, b, c and d: that is undecided; the optimum is 200."


def test_seeds_that_can_decide_nothing(made_up):
    lead = said(made_up, {("a", "b"): "undecided"}, {"a": 100.0, "b": 90.0}, fewest=7).lead
    assert lead.startswith(
        "Undecided: 4 seeds cannot tell 2 agents apart, whatever they score; it takes 7 or more. "
    )


@pytest.mark.parametrize(
    ("metric", "medians", "by_median"),
    [
        ("final", {"a": 50.0, "b": 95.0, "c": 60.0}, "b (95 against 50)"),
        ("final", {"a": 95.0, "b": 50.0, "c": 60.0}, None),
        ("final", {"a": 95.0, "b": 95.0, "c": 60.0}, None),
        # Of regret the lower is the better.
        ("regret", {"a": 95.0, "b": 50.0, "c": 60.0}, "b (50 against 95)"),
        ("regret", {"a": 50.0, "b": 95.0, "c": 60.0}, None),
    ],
)
def test_where_mean_and_median_differ_it_is_said(made_up, metric, medians, by_median):
    lead = said(made_up, {("a", "b"): "undecided"}, medians=medians, metric=metric).lead
    text = f" By the mean a comes first (100 against 90), by the median {by_median}."
    assert lead.endswith(text) is (by_median is not None)
    assert ("by the median" in lead) is (by_median is not None)


def test_an_agent_that_is_worse_is_named_as_the_one_that_loses(made_up):
    """Ranks go by the mean: the first of a pair may be the worse one."""
    found = said(made_up, {("a", "b"): "worse", ("a", "c"): "better", ("b", "c"): "better"})
    assert found.pairs == (
        "a is better than c (by 10 [5, 15]).",
        "b is better than a (by -10 [-15, -5]) and c (by 10 [5, 15]).",
    )


def test_what_is_open_is_in_one_sentence_for_each_agent(made_up):
    place = place_of(made_up, {})
    pairs = (
        made_up.pair("a", "b", "undecided", seeds_needed=793),
        made_up.pair("a", "c", "undecided"),
    )
    found = conclusion(made_up.study(list(MEANS)), replace(place, pairs=pairs))
    (sentence,) = found.pairs
    assert sentence == (
        "a is undecided against b (difference 10 [5, 15]; about 793 seeds are needed to decide) "
        "and c (difference 10 [5, 15])."
    )


def test_the_matrix_has_each_pair_from_both_sides(made_up):
    place = place_of(made_up, {("a", "b"): "worse", ("b", "c"): "equivalent"})
    verdicts = {names: pair.verdict for names, pair in pairs_both_ways(place).items()}
    assert verdicts == {
        ("a", "b"): "worse",
        ("b", "a"): "better",
        ("b", "c"): "equivalent",
        ("c", "b"): "equivalent",
    }
    assert says_more(place)


def test_a_matrix_of_questions_says_nothing(made_up):
    assert not says_more(place_of(made_up, {("a", "b"): "undecided"}))
    two = place_of(made_up, {("a", "b"): "better"}, {"a": 100.0, "b": 90.0})
    assert not says_more(two)
