"""What the figures of the book are drawn from, and what is said where a statement fails."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.mdp import policy_iteration

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "textbook"


@pytest.fixture(autouse=True)
def as_scripts(monkeypatch):
    """They import each other, as scripts in one folder do."""
    monkeypatch.syspath_prepend(str(FOLDER))
    yield
    for name in ("_figures", "blackjack", "random_walk"):
        sys.modules.pop(name, None)


def test_true_values_are_those_of_the_model():
    from random_walk import WALK, true_values

    env_kwargs = {"n_states": 19, "left_reward": -1}
    model = transition_model(gym.make(WALK, **env_kwargs))
    found = policy_iteration(model, 1.0).values  # it has one action
    np.testing.assert_allclose(true_values(env_kwargs)[1:-1], found[1:-1], atol=1e-9)


def test_the_policy_that_sticks_on_twenty_is_worth_what_its_rules_say():
    from blackjack import exact_values, observations

    values = exact_values()[observations()]
    # Sticking asks for no ace; below 12 are no states of the figure.
    np.testing.assert_allclose(values[0, -2:], values[1, -2:])
    # On 20 the dealer's card decides: an ace is bad, a 9 is good for the player.
    assert values[0, -2].argmin() == 0
    assert (values[0, :-2] < values[1, :-2]).all()


def test_what_does_not_hold_is_said(tmp_path, capsys, monkeypatch):
    from _figures import Statement, canvas, main

    def draw(n_runs):
        return canvas("t", "x", "y")[0], [Statement("it is so", str(n_runs), n_runs == 1)]

    figures = {"1.1": (draw, 1), "1.2": (draw, 2)}
    monkeypatch.setattr(sys, "argv", ["", "1.1", "--folder", str(tmp_path)])
    main("", figures)
    monkeypatch.setattr(sys, "argv", ["", "--folder", str(tmp_path)])
    with pytest.raises(SystemExit, match="1"):
        main("", figures)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["figure_1_1.png", "figure_1_2.png"]
    assert "no" in capsys.readouterr().out
