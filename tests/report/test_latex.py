"""The study as LaTeX: no text is a command, tables are whole, and it says what Markdown says."""

import re
from dataclasses import replace

import pytest

from report.documents import MARKUPS, headline, latex_text, table_as, verdicts_as


@pytest.mark.parametrize(
    ("text", "latex"),
    [
        ("double_dqn by 2 [1, 3]", r"double\_dqn by 2 [1, 3]"),
        ("50 % of #1 & {2}", r"50 \% of \#1 \& \{2\}"),
        (r"\input{x} $a^b$", r"\textbackslash{}input\{x\} \$a\textasciicircum{}b\$"),
        ("<a>|", r"\textless{}a\textgreater{}\textbar{}"),
        ('~ `b "c"', r"\textasciitilde{} {\char96}b {\char34}c{\char34}"),
        ("--seeds a---b ,,x ''", r"-{}-seeds a-{}-{}-b ,{},x '{}'"),
        ("-1,000 [-2, 3] Lake-v1 -∞", r"$-$1,000 [$-$2, 3] Lake-v1 $-$$\infty$"),
        ("[1] *", r"{}[1] *"),
        ("*x", r"{}*x"),
        ("ε = 0.1 ± 2 λ ά Ω", r"$\varepsilon$ = 0.1 $\pm$ 2 $\lambda$ ά Ω"),
        ("two\n\nlines \x1b[1m", r"two lines \textbackslash{}x1b[1m"),
        ("café 中", "café 中"),
    ],
)  # fmt: skip
def test_nothing_of_a_text_is_a_command(text, latex):
    assert latex_text(text) == latex


def test_a_table_has_the_rules_of_booktabs_and_no_others(made_up):
    agents = [made_up.agent(name, 50) for name in "ab"]
    analysis = made_up.analysis([made_up.environment(agents)], "ab")
    lines = table_as("tex", headline(analysis)).splitlines()
    assert lines[2].startswith(r"\caption{Score of the median run: ")
    assert lines[4:] == [
        r"\begin{tabular}{lr}",
        r"\toprule",
        r" & lake \\",
        r"\midrule",
        r"\texttt{a} & \textbf{1.000} \\",
        r"\texttt{b} & 1.000 \\",
        r"\bottomrule",
        r"\end{tabular}}",
        r"\end{table}",
    ]


@pytest.fixture
def hostile(made_up):
    """A study whose labels are made of what LaTeX reads as commands."""
    names = [r"\end{table}", "a_b & 50%", "[1]", "*$x^2$"]
    agents = [made_up.agent(name, mean) for name, mean in zip(names, (90, 80, 70, 60), strict=True)]
    pairs = (made_up.pair(names[0], names[1], "equivalent"),)
    return made_up.analysis([made_up.environment(agents, "lake #1", pairs=pairs)], names)


def test_whatever_labels_say_every_group_and_environment_is_closed(hostile):
    text = verdicts_as("tex", hostile, "python compare.py 'a_b & 50%' --x")
    plain = re.sub(r"\\[{}$&#%_]", "", text)
    assert plain.count("{") == plain.count("}")
    assert plain.count("$") % 2 == 0
    begun, ended = (re.findall(rf"\\{which}\{{(\w+)\}}", plain) for which in ("begin", "end"))
    assert sorted(begun) == sorted(ended)
    assert begun.count("table") == 2  # the headline, and one environment
    for rows in re.findall(r"\\midrule\n(.*?)\\bottomrule", plain, re.DOTALL):
        # What no agent has is left out: runs that failed, and the processor time.
        assert {line.count("&") for line in rows.splitlines()} <= {1, 4}
        assert all(line.endswith(r"\\") for line in rows.splitlines())
    # Comments stand at the top alone, and say what the text needs.
    lines = text.splitlines()
    assert lines[0] == r"% Taken in by \input; above it: \usepackage{booktabs,graphicx}"
    assert "%" not in re.sub(r"\\%|\{%$", "", "\n".join(lines[1:]), flags=re.MULTILINE)


def test_it_says_which_signs_need_another_engine(made_up):
    agents = [made_up.agent(name, 90.0) for name in ("中", "é")]
    found = made_up.analysis([made_up.environment(agents)], ["中", "é"])
    lines = verdicts_as("tex", found, "python compare.py").splitlines()
    assert lines[1] == "% With XeLaTeX or LuaLaTeX, and a font that has these signs: 中"


def test_both_languages_say_the_same(made_up):
    names = ["low", "first"]
    agents = [made_up.agent(name, mean) for name, mean in zip(names, (30, 90), strict=True)]
    place = made_up.environment(agents, pairs=(made_up.pair("low", "first", "worse"),))
    found = made_up.analysis([replace(place)], names)
    both = [verdicts_as(markup, found, "python compare.py") for markup in MARKUPS]
    words = [re.findall(r"[\d.]+|[a-z]{3,}", one) for one in both]
    assert [word for word in words[0] if word not in words[1]] == []
    assert r"\texttt{first} & \textbf{1.800} \\" in both[1]
