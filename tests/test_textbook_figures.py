"""What the figures of the book are drawn from, on few runs; and that its statements can fail."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from envs.known_models import transition_model
from mdp.graph import PolicyChain

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "textbook"


@pytest.fixture(autouse=True)
def as_scripts(monkeypatch):
    """They import each other, as scripts in one folder do."""
    monkeypatch.syspath_prepend(str(FOLDER))
    yield
    for name in [n for n in sys.modules if n.startswith(("_figures", "figure_"))]:
        del sys.modules[name]


@pytest.mark.parametrize("env_kwargs", [{}, {"n_states": 19, "left_reward": -1}])
def test_true_values_are_those_of_the_model(env_kwargs):
    from _figures import WALK, true_values

    model = transition_model(gym.make(WALK, **env_kwargs))
    chain = PolicyChain.build(model, np.ones((model.n_states, 1)))
    solved = chain.solve(chain.mean(chain.reward), 1.0)
    assert true_values(env_kwargs)[chain.states] == pytest.approx(solved, abs=1e-12)


def test_the_policy_that_sticks_on_twenty_is_worth_what_its_rules_say():
    from figure_5_1 import exact_values, observations

    values = exact_values()[observations()]
    # Sticking asks for no ace; below 12 are no states of the figure.
    np.testing.assert_allclose(values[0, -2:], values[1, -2:])
    # On 20 the dealer's card decides: an ace is bad, a 9 is good for the player.
    assert values[0, -2].argmin() == 0
    assert (values[0, :-2] < values[1, :-2]).all()


def test_statements_can_fail():
    import figure_5_1
    import figure_6_2
    import figure_6_3
    import figure_6_5
    import figure_7_2
    import figure_12_6

    flat = np.zeros(figure_6_5.N_EPISODES)
    sixes = {(algo, size): 0.1 for algo, sizes in figure_6_2.STEP_SIZES.items() for size in sizes}
    threes = {algo: ([0.0] * 10, [0.0] * 10) for algo in figure_6_3.LABELS}
    wrong = [
        *figure_5_1.statements(*np.zeros((2, 2, 10, 10)), np.ones((2, 10, 10))),
        *figure_6_2.statements(sixes, sixes),
        *figure_6_3.statements(threes)[:1],
        *figure_6_3.statements(threes)[2:],
        *figure_6_5.statements(flat, flat),
        *figure_7_2.statements(dict.fromkeys(figure_7_2.LENGTHS, 0.3)),
        *figure_12_6.statements({decay: [0.3] for decay in figure_12_6.DECAYS}),
    ]
    assert not any(statement.holds for statement in wrong)


def test_what_does_not_hold_is_said(tmp_path, capsys):
    from _figures import Statement, canvas, finish

    figure, _ = canvas("t", "x", "y")
    finish("a", figure, tmp_path, [Statement("it is so", "1", True)])
    with pytest.raises(SystemExit, match="1"):
        finish("b", figure, tmp_path, [Statement("it is so", "2", False)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]
    assert "no" in capsys.readouterr().out
