"""Ratings: oracles by hand, by planning and by brute force; forms of tables; refusals."""

import itertools
import json
import pickle
import subprocess
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3 import PPO

from rl_yardstick import Run, mdp, rate
from rl_yardstick.envs import known_models
from rl_yardstick.pipeline.errors import UserError
from tests.pipeline.short_runs import trained

LAKE, DRY, POLE = "FrozenLake-v1", {"is_slippery": False}, "CartPole-v1"


def planned(env_id, discount=0.99, **kwargs):
    """Optimal action values of an environment."""
    model = known_models.transition_model(gym.make(env_id, **kwargs))
    return mdp.value_iteration(model, discount).action_values


@pytest.fixture(scope="module")
def lake():
    return planned(LAKE)


def test_the_optimum_zeros_and_policies_by_hand():
    best = rate(planned("Warehouse-v0", 1.0), "Warehouse-v0")
    assert (best.score, best.success_rate) == (pytest.approx(1), 1)
    zeros = rate(np.zeros((16, 4)), LAKE, **DRY)
    assert (zeros.mean_return, zeros.notes[0]) == (0, "never trained: every value is 0")
    assert zeros.map.splitlines() == ["????", "?X?X", "???X", "X??G"]
    # Down, down, right, right, down, right: the shortest way without ice.
    table = np.zeros((16, 4))
    for state, action in {0: 1, 4: 1, 8: 2, 9: 2, 13: 2, 10: 1, 14: 2}.items():
        table[state, action] = 1
    found = rate(table, LAKE, **DRY)
    assert (found.mean_return, found.optimum, found.score, found.mean_length) == (1, 1, 1, 6)
    assert found.map.splitlines() == ["v???", "vX?X", ">>vX", "X>>G"]
    assert (found.equal_met, found.equal_elsewhere) == (0, 4)
    assert repr(found).startswith("ndarray on FrozenLake-v1 (is_slippery False): ")
    assert "score 1" in repr(found)
    chances = np.where(table.any(axis=1, keepdims=True), table, 0.25)
    chances[4] = 0, 0.6, 0.4, 0  # to the right is a hole
    for policy in (chances, lambda state: chances[state]):
        assert rate(policy, LAKE, **DRY).mean_return == pytest.approx(0.6)


def test_a_policy_is_random_in_states_that_it_lacks():
    # In state 8, a random action leads on, into a hole, or to where it is tried again.
    found = rate({0: 1, 4: 1, 9: 2, 10: 1, 14: 2}, LAKE, **DRY)
    assert found.mean_return == pytest.approx(0.5)
    assert found.notes[0] == "1 of 6 states on its way have no action: taken as random"
    assert found.map.splitlines()[2] == "?>vX"


def test_illegal_actions_are_no_missing_update(lake):
    legal = lake == lake.max(axis=1, keepdims=True)
    found = rate(np.where(legal, lake, -np.inf), LAKE)
    assert (found.equal_met, found.equal_elsewhere) == (0, 0)
    assert "?" not in found.map


def test_the_range_of_ties_is_that_of_all_policies():
    env = gym.make("DeepSea-v0", size=3)
    model = known_models.transition_model(env)
    table = np.random.default_rng(1).integers(0, 2, model.prob.shape[:2])
    tops = [np.flatnonzero(row == row.max()) for row in table]
    choices = [top if here else [0] for top, here in zip(tops, model.reachable, strict=True)]
    returns = [
        mdp.policy_return(model, np.array(policy), 100).expected_return
        for policy in itertools.product(*choices)
    ]
    found = rate(table, env)
    assert found.ties == sum(len(choice) > 1 for choice in choices) > 2
    assert found.ties_least == pytest.approx(min(returns))
    assert found.ties_most == pytest.approx(max(returns)) != found.ties_least
    assert found.mean_return == pytest.approx(returns[0])
    assert f"ties in {found.ties} states, {found.ties_met} on its way" in found.notes[0]


def test_another_order_of_actions_is_found(lake):
    swapped = rate(lake[:, [1, 0, 3, 2]], LAKE)
    assert swapped.notes[0] == "with actions ordered down, left, up, right it would score 0.99"
    assert not any("would" in note for note in rate(lake, LAKE).notes)


def forms(values):
    """The same table in the forms in which people hold it."""
    pairs = {(s, a): values[s, a] for s, a in np.ndindex(values.shape)}
    rows = [(*pair, value) for pair, value in pairs.items()]
    top = values == values.max(axis=1, keepdims=True)
    return {
        "a list": values.tolist(),
        "by state and action": {s: dict(enumerate(row)) for s, row in enumerate(values)},
        "by state": dict(enumerate(values)),
        "by text": {f"({s},)": row.tolist() for s, row in enumerate(values)},
        "by pair": pairs,
        "of a course": {"qtable": values, "eval_seed": list(range(100)), "env_id": LAKE},
        "in objects": np.array(dict(enumerate(values)), dtype=object),
        "actions": values.argmax(axis=1),
        "actions by state": dict(enumerate(values.argmax(axis=1).tolist())),
        "a function": lambda state: int(values[state].argmax()),
        "an agent": SimpleNamespace(act=lambda state: values[state].argmax()),
        "a predictor": SimpleNamespace(predict=lambda state: (values[state].argmax(), None)),
        "another agent": SimpleNamespace(get_action=lambda state: values[state].argmax()),
        "transposed": values.T,
        "masked": np.ma.masked_array(np.where(top, values, 9), ~top),
        "masked by state": {s: np.ma.masked_array(values[s], ~top[s]) for s in range(len(values))},
        "below the actions": np.vstack([range(4), values]),
        "a tensor": th.tensor(values),
        "a frame": pd.DataFrame(values).sample(frac=1, random_state=0),
        "a long frame": pd.DataFrame(rows, columns=["state", "action", "q"]),
        "a series": pd.Series(values.argmax(axis=1)),
        "a chooser": SimpleNamespace(choose_action=lambda state: values[state].argmax()),
    }


def test_every_form_of_a_table_has_the_same_rating(lake):
    expected = rate(lake, LAKE).mean_return
    for form, table in forms(lake).items():
        assert rate(table, LAKE).mean_return == pytest.approx(expected), form


def hands():
    """Gymnasium's Blackjack with the policy to stick from 18 on, as action values."""
    keys = itertools.product(range(4, 22), range(1, 11), (False, True))
    return {key: np.array([1.0, 0.0] if key[0] >= 18 else [0.0, 1.0]) for key in keys}


def test_hands_of_blackjack_in_every_form():
    table, whole = hands(), np.zeros((32, 11, 2, 2))
    for (total, dealer, ace), row in table.items():
        whole[total, dealer, int(ace)] = row
    pairs = {(hand, action): row[action] for hand, row in table.items() for action in (0, 1)}
    policy = {hand: int(row.argmax()) for hand, row in table.items()}
    texts = {str(hand): row.tolist() for hand, row in table.items()}
    kinds = [table, whole, whole.reshape(-1, 2), whole.argmax(axis=-1), pairs, policy, texts]
    kinds.append(lambda hand: int(hand[0] < 18))
    found = {round(rate(kind, "Blackjack-v1").mean_return, 12) for kind in kinds}
    env = gym.make("Blackjack-v1")
    stands = (known_models.observations_of_states(env)[:, 0] < 18).astype(int)
    exact = mdp.policy_return(known_models.transition_model(env), stands, 1000).expected_return
    assert found == {round(exact, 12)}


REFUSED = {
    "another map": (np.zeros((64, 4)), "(states x actions); it fits --env-kwargs map_name:8x8"),
    "another game": (np.zeros((500, 6)), "500 x 6: FrozenLake-v1 needs 16 x 4"),
    "values of states": (np.linspace(0, 1, 16), "one value of each state"),
    "nan": (np.where(np.eye(16, 4) > 0, np.nan, 1.0), "nan in states [0, 1, 2, 3]: illegal"),
    "a state too many": ({s: [0, 0, 0, 1] for s in range(64)}, "([16] is not in Discrete(16)): Fr"),
    "an action too many": ({(0, 9): 1.0, (1, 0): 2.0}, "has an action 9: "),
    "named actions": ({s: {"left": 0.0, "up": 0.0} for s in range(16)}, "the key (0, 'left'), "),
    "nan in pandas": (pd.DataFrame(np.eye(16, 4)).replace(1, np.nan), "nan in states [0, 1, 2, 3]"),
    "a state twice": (pd.DataFrame(np.eye(16, 4), index=[0] * 16), "several rows of one state"),
    "a class to be given something": (type("A", (), {"__init__": lambda self, env: 0}), "'env'"),
    "a function of two": (lambda state, values: 0, "'values': a class gets none, a policy"),
    "keys of two kinds": ({0: [0] * 4, (1, 2): [0] * 4}, "no state of FrozenLake-v1"),
    "hands": (hands(), "[4, 1, 0] is not in Discrete(16)"),
    "ragged": ([[1, 2], [3]], "holds no table"),
    "words": ({0: "left", 1: "right"}, "holds no table"),
    "a number": (3, "is no table"),
    "two tables": ((np.zeros((16, 4)), np.ones((16, 4))), "several tables, tuple[0], tuple[1]"),
    "a name": (lambda state: "left", "must return an action or 4 probabilities"),
    "too many actions": (lambda state: 7, "must return an action or 4 probabilities"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_say_what_would_be_right(case):
    what, said = REFUSED[case]
    with pytest.raises(UserError) as refusal:
        rate(what, LAKE)
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_without_a_model_episodes_are_sampled():
    pushes = rate(lambda obs: int(obs[2] > 0), "CartPole-v1")
    assert not pushes.evaluation.is_exact
    assert pushes.notes == ("sampled, 100 episodes",)
    assert 20 < pushes.mean_return < 100
    assert pushes.optimum == 500
    rng = np.random.default_rng(0)
    draws = rate(lambda state: int(rng.integers(4)), LAKE)
    assert draws.notes == ("it draws its actions, or remembers", "sampled, 100 episodes")
    with pytest.raises(UserError, match="bins:10"):
        rate(np.zeros((10, 10, 10, 10, 2)), "CartPole-v1")
    bins = {"bins": [1, 1, 2, 1], "low": [-9, -9, -1, -9], "high": [9, 9, 1, 9]}
    for table in (np.array([[1.0, 0.0], [0.0, 2.0]]), {(0, 0, 0, 0): [1, 0], (0, 0, 1, 0): [0, 2]}):
        assert rate(table, "CartPole-v1", bins=bins).mean_return == pushes.mean_return


def test_a_model_and_its_run_have_the_rating_of_its_training(tmp_path):
    run, outcome = trained("qlearning", LAKE, {}, folder=tmp_path, n_timesteps=3000)
    for path in (run.path, run.path / f"{LAKE}.zip", Run(run.path)):
        assert rate(path).mean_return == outcome.final.mean_return
    agent = PPO("MlpPolicy", LAKE, n_steps=8, batch_size=8, device="cpu", seed=0)
    actions = [int(agent.predict(np.array(s), deterministic=True)[0]) for s in range(16)]
    assert rate(agent, LAKE).mean_return == rate(np.array(actions), LAKE).mean_return


def test_tables_need_no_pytorch_and_files_run_nothing(tmp_path, typed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("deeper", "images", ".git"):
        (tmp_path / "class" / folder).mkdir(parents=True)
    (tmp_path / "class" / ".git" / "a.npy").write_bytes(b"")
    np.save("class/deeper/zeros.npy", np.zeros((16, 4)))
    (tmp_path / "class" / "evil.pkl").write_bytes(b"cos\nmkdir\n(Vmark\ntR.")
    (tmp_path / "class" / "notes.md").write_text("not a table")
    named = {"env_id": "Taxi-v3", "qtable": planned(LAKE)}
    (tmp_path / "class" / "hf.pkl").write_bytes(pickle.dumps(named))
    words = ["--env", LAKE, "--table", "marks.csv", "--json", "marks.json"]
    out = typed.done("yardstick", "rate", "class", *words)
    assert "1 of 3 could not be rated" in out
    rows = (tmp_path / "marks.csv").read_text().splitlines()
    names = "deeper/zeros.npy", "evil.pkl", "hf.pkl"
    assert [row.split(",")[0] for row in rows[1:]] == [f"class/{name}" for name in names]
    assert "its file names Taxi-v3" in rows[3]
    assert json.loads((tmp_path / "marks.json").read_text())["class/hf.pkl"]["score"] > 0.9
    assert not (tmp_path / "mark").exists()
    assert max(map(len, out.splitlines())) <= 80
    none_rated = typed("yardstick", "rate", "class/evil.pkl", "class/evil.pkl", "own.npy", *words)
    assert (none_rated[0], "2 of 2 could not be rated" in none_rated[1]) == (2, True)
    (tmp_path / "own.py").write_text("policy = lambda state: 2\nright = lambda obs: 1\n")
    out = typed.done("yardstick", "rate", "own.py:policy", "--env", LAKE)
    assert ("score 0 " in out, "standard error" in out) == (True, False)
    assert "its own code ran" in out
    told = typed.done("yardstick", "rate", "own.py:right", "--env", POLE)
    assert "standard error 0.0" in told
    refusal = typed.refused("yardstick", "rate", "own.py:value", "--env", LAKE)
    assert "own.py has no 'value'" in refusal
    sys.modules.pop("own", None)
    light = f"import numpy, sys\nfrom rl_yardstick import rate\nrate(numpy.eye(16, 4), '{LAKE}')"
    code = f"{light}\nsys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
