"""Agents on tables that learn a model: what they plan, and that the model is kept."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.tabular.dyna import MOST_BYTES, DatedModelPolicy, ModelPolicy
from agents.tabular.optimism import CountedModelPolicy
from agents.tabular.prioritized_sweeping import NONE, _are_lists, _is_queue
from agents.tabular.updates import learn_from_all
from envs.known_models import transition_model
from mdp import TransitionModel, value_iteration
from safe_files.files import MAX_ARCHIVE_BYTES
from tests.agents.test_engine import differences, make, state_of
from tests.agents.test_temporal_difference import Spaces

NAMES = ("dyna_q", "dyna_q_plus", "prioritized_sweeping", "r_max")
MAZE = {"desc": ["S.#", "..G"], "step_reward": 0, "shelf_reward": 0, "goal_reward": 1}


class Taught:
    """An agent that is told the steps of one environment."""

    def __init__(self, name, n_states, n_actions=1, **settings):
        settings = {"gamma": 0.5, **settings}
        self.agent = load_algorithm(name)(env=Spaces(n_states, n_actions), seed=0, **settings)
        self.workspace = self.agent._make_workspace(self.agent.rng, 1)

    def step(self, obs, action, reward, next_obs, *, terminated=False, step_size=1.0):
        self.workspace.note_progress(0.0, step_size, 0)
        env = self.workspace.envs[0]
        env["obs"], env["action"], env["reward"], env["next_obs"] = obs, action, reward, next_obs
        env["new_obs"], env["terminated"] = next_obs, terminated
        assert learn_from_all(*self.workspace.arrays) == -1

    @property
    def table(self):
        return self.agent.policy.q_table

    @property
    def model(self):
        return self.agent.policy.model


# --- Dyna-Q ---------------------------------------------------------------------------------------


def test_without_planning_dyna_q_is_q_learning():
    plain, planning = (
        make(name, "FrozenLake-v1", 3, learning_rate="sample_average", **settings).learn(2000)
        for name, settings in (("qlearning", {}), ("dyna_q", {"planning_steps": 0}))
    )
    assert differences(state_of(plain), state_of(planning)) == {}


def test_planning_repeats_the_update():
    """Only one pair is known: one real update and three imagined ones, from 0 towards 2 + 4."""
    taught = Taught("dyna_q", 2, 2, planning_steps=3)
    taught.agent.policy.q_tables[0, 1] = th.tensor([4.0, 8.0])
    taught.step(0, 1, 2.0, 1, step_size=0.1)
    assert taught.table[0, 1] == pytest.approx(6 * (1 - 0.9**4), rel=1e-14)
    assert taught.agent.policy.visit_counts[0].tolist() == [[0, 1], [0, 0]]


def test_sample_averages_count_real_visits():
    taught = Taught("dyna_q", 1, planning_steps=2, learning_rate="sample_average")
    for n, reward in enumerate((4.0, 1.0), start=1):
        before = taught.table[0, 0]
        taught.step(0, 0, reward, 0, terminated=True)
        # The last outcome thrice, with a step size of 1/N.
        assert taught.table[0, 0] == pytest.approx(reward + (before - reward) * (1 - 1 / n) ** 3)


def test_the_model_holds_the_last_outcomes():
    taught = Taught("dyna_q", 3, planning_steps=0, outcomes_kept=2)
    for reward, next_obs, terminated in ((1.0, 1, False), (2.0, 2, True), (3.0, 0, False)):
        taught.step(0, 0, reward, next_obs, terminated=terminated)
    model = taught.model
    assert model.rewards[0, 0].tolist() == [3, 2]
    assert model.next_obs[0, 0].tolist() == [0, 2]
    assert model.terminated[0, 0].tolist() == [False, True]
    assert (model.counts.ravel().tolist(), model.n_pairs.tolist()) == ([3, 0, 0], [1])


def test_planning_draws_pairs_and_outcomes_alike():
    """With a step size of nearly 0 the sum of updates tells how often which reward was drawn."""
    taught = Taught("dyna_q", 2, gamma=0.0, planning_steps=0, outcomes_kept=3)
    for obs, reward in ((0, 1.0), (0, 10.0), (0, 100.0), (1, 1000.0)):
        taught.step(obs, 0, reward, 0, step_size=0.0)
    n, tiny = 30_000, 1e-12
    taught.agent.planning_steps = n
    taught.workspace = taught.agent._make_workspace(taught.agent.rng, 1)
    taught.step(1, 0, 1000.0, 0, step_size=tiny)
    drawn = taught.table[:, 0] / tiny / n
    # Half of them on each pair; a third on each outcome. Four standard errors.
    assert drawn[1] == pytest.approx(500, abs=4 * 1000 * 0.5 / n**0.5)
    assert drawn[0] == pytest.approx(111 / 6, abs=4 * 100 * (1 / 6) ** 0.5 / n**0.5)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("dyna_q", {"planning_steps": 50}),
        ("prioritized_sweeping", {"planning_steps": 50, "threshold": 0.0}),
    ],
)
def test_much_planning_ends_in_the_optimum(name, settings):
    """All pairs of a small maze were tried: their values are those of the best policy, exactly."""
    env = make_vec_env("Warehouse-v0", seed=0, env_kwargs=MAZE)
    uniform = {"exploration_decay": "constant", "exploration_initial_eps": 1.0}
    agent = load_algorithm(name)(
        env=env, seed=0, learning_rate=1.0, gamma=0.9, **uniform, **settings
    ).learn(1500)
    model = transition_model(gym.make("Warehouse-v0", **MAZE))
    tried = agent.policy.model.counts > 0
    assert tried[model.reachable].all()
    expected = value_iteration(model, 0.9).action_values
    np.testing.assert_allclose(agent.policy.q_table[tried], expected[tried], atol=1e-12)


# --- Dyna-Q+ --------------------------------------------------------------------------------------


def test_what_was_not_tried_for_long_is_worth_more():
    """Action 1 of state 0 is never tried: it stays, earns nothing, and its bonus grows by sqrt."""
    taught = Taught("dyna_q_plus", 1, 2, gamma=0.0, planning_steps=40, kappa=0.5)
    for step in range(1, 6):
        taught.step(0, 0, 3.0, 0, terminated=True)
        # Of the action that was tried just now no time has passed.
        assert taught.table[0].tolist() == [3.0, 0.5 * np.sqrt(step)]
    taught.step(0, 1, 7.0, 0, terminated=True)
    assert taught.table[0].tolist() == [3 + 0.5 * np.sqrt(1), 7.0]
    assert taught.model.pairs.tolist() == [0, 1]
    assert (taught.model.tried_at.tolist(), taught.model.time.tolist()) == ([[5, 6]], [6])


def test_only_planning_earns_the_bonus():
    taught = Taught("dyna_q_plus", 1, 2, planning_steps=0, kappa=100.0)
    taught.step(0, 0, 3.0, 0, terminated=True)
    assert taught.table[0].tolist() == [3.0, 0.0]


def test_what_is_masked_is_not_considered():
    env = make_vec_env("Warehouse-v0", 2, seed=0)
    agent = load_algorithm("dyna_q_plus")(env=env, seed=0, mask_actions=True).learn(3000)
    allowed, model = agent.policy.masks, agent.policy.model
    considered = np.zeros(allowed.size, dtype=bool)
    considered[model.pairs[: model.n_pairs[0]]] = True
    considered = considered.reshape(allowed.shape)
    met = model.counts.any(axis=1)
    assert (considered == (allowed & met[:, None])).all()
    assert model.n_pairs[0] == considered.sum() > 100


# --- prioritised sweeping -------------------------------------------------------------------------


def chain(planning_steps, **settings):
    """Three states in a row, met one after the other; only the last step earns something."""
    taught = Taught("prioritized_sweeping", 4, planning_steps=planning_steps, **settings)
    taught.step(0, 0, 0.0, 1)
    taught.step(1, 0, 0.0, 2)
    assert not taught.model.n_queued.any()
    taught.step(2, 0, 8.0, 3, terminated=True)
    return taught


def test_news_of_the_goal_runs_backwards():
    assert chain(5).table[:, 0].tolist() == [2.0, 4.0, 8.0, 0.0]
    taught = chain(2)
    assert taught.table[:, 0].tolist() == [0.0, 4.0, 8.0, 0.0]
    # The first state is next: its error is half of 4.
    assert (taught.model.n_queued[0], taught.model.queue[0], taught.model.urgency[0]) == (1, 0, 2)
    taught.step(2, 0, 8.0, 3, terminated=True)
    assert taught.table[0, 0] == 2.0
    assert not taught.model.n_queued.any()


def test_small_errors_are_left():
    assert chain(5, threshold=3.0).table[:, 0].tolist() == [0.0, 4.0, 8.0, 0.0]
    assert chain(5, threshold=2.0).table[:, 0].tolist() == [0.0, 4.0, 8.0, 0.0]
    assert chain(5, threshold=1.9).table[:, 0].tolist() == [2.0, 4.0, 8.0, 0.0]


def test_the_largest_error_comes_first():
    taught = Taught("prioritized_sweeping", 8, planning_steps=0)
    rewards = [3.0, -7.0, 1.0, 5.0, 2.0, -4.0, 6.0]
    for obs, reward in enumerate(rewards):
        taught.step(obs, 0, reward, 7, terminated=True)
    taught.step(6, 0, -0.5, 7, terminated=True)  # as urgent as before, but another reward
    taught.agent.planning_steps = 1
    taught.workspace = taught.agent._make_workspace(taught.agent.rng, 1)
    order = []
    for _ in rewards:
        before = taught.table[:, 0].copy()
        taught.step(7, 0, 0.0, 7, terminated=True)
        order.append(int(np.flatnonzero(taught.table[:, 0] != before)[0]))
    assert order == [1, 6, 3, 5, 0, 4, 2]
    assert taught.table[:, 0].tolist() == [3.0, -7.0, 1.0, 5.0, 2.0, -4.0, -0.5, 0.0]


def test_a_changed_outcome_changes_what_leads_where():
    taught = Taught("prioritized_sweeping", 3, 2, planning_steps=0)
    taught.step(0, 0, 0.0, 2)
    taught.step(1, 0, 0.0, 2)
    taught.step(1, 1, 0.0, 2)
    assert taught.model.first_into.tolist() == [NONE, NONE, 3]
    taught.step(1, 0, 0.0, 0)  # from the middle of the list
    assert taught.model.first_into.tolist() == [2, NONE, 3]
    assert (taught.model.behind[3], taught.model.before[0]) == (0, 3)
    taught.step(1, 1, 0.0, 2, terminated=True)  # the first of it
    assert taught.model.first_into.tolist() == [2, NONE, 0]
    assert _are_lists(taught.model)


def test_queue_and_lists_hold_through_a_training():
    """On slippery ground outcomes change all the time."""
    agent = make("prioritized_sweeping", "FrozenLake8x8-v1", 2, threshold=1e-9, initial_q_std=1.0)
    agent.learn(5000)
    model = agent.policy.model
    n = int(model.n_queued[0])
    assert n > 10
    assert _is_queue(model)
    assert _are_lists(model)
    urgency = model.urgency[model.queue[:n]]
    assert (urgency[(np.arange(1, n) - 1) // 2] >= urgency[1:]).all()


# --- R-max ----------------------------------------------------------------------------------------


def test_r_max_by_hand():
    taught = Taught("r_max", 2, 2, known_after=2, value_bound=10.0)
    taught.step(0, 0, 1.0, 0)
    assert (taught.table == 10).all()
    # Once back, once on: 0.5 * (1 + .5 V(0)) + 0.5 * (3 + .5 V(1)), where both are worth 10.
    taught.step(0, 0, 3.0, 1)
    assert taught.table.tolist() == [[7.0, 10.0], [10.0, 10.0]]
    # The other action ends the episode: V(0) = max(Q(0, 0), 4), Q(0, 0) = 4.5 + .25 V(0) = 6.
    taught.step(0, 1, 4.0, 1, terminated=True)
    taught.step(0, 1, 4.0, 1, terminated=True)
    np.testing.assert_allclose(taught.table, [[6, 4], [10, 10]], atol=1e-4)
    # What is known is known: nothing more is counted.
    taught.step(0, 1, 400.0, 0)
    assert taught.model.counts.tolist() == [[2, 2], [0, 0]]
    assert taught.agent.policy.visit_counts[0].tolist() == [[2, 3], [0, 0]]


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.999, 0.9999])
def test_r_max_keeps_to_its_tolerance(gamma):
    taught = Taught("r_max", 1, gamma=gamma, known_after=1, tolerance=1e-4)
    taught.step(0, 0, 0.5, 0)
    assert taught.table[0, 0] == pytest.approx(0.5 / (1 - gamma), abs=1e-4)


def test_r_max_plans_the_optimum_of_what_it_has_counted():
    env = make_vec_env("FrozenLake-v1", 2, seed=0)
    settings = {"known_after": 4, "value_bound": 1.0, "gamma": 0.9, "tolerance": 1e-9}
    agent = load_algorithm("r_max")(env=env, seed=0, **settings).learn(400)
    model = agent.policy.model
    known = model.counts == 4
    assert 20 < known.sum() < known.size
    # What is not known ends the episode, and earns the most.
    prob = np.where(known[..., None], model.tallies / 4, [1.0, 0, 0, 0])
    tallies = np.maximum(model.tallies, 1)
    counted = TransitionModel(
        prob=prob,
        next_state=model.next_obs,
        reward=np.where(known[..., None], model.rewards / tallies, 1.0),
        terminated=model.terminated | ~known[..., None],
        initial=np.full(16, 1 / 16),
    )
    optimum = value_iteration(counted, 0.9).action_values
    np.testing.assert_allclose(agent.policy.q_table, optimum, atol=1e-8)


@pytest.mark.parametrize("env_id", ["DynaMaze-v0", "WindyGridworld-v0", "DeepSea-v0"])
def test_one_try_is_enough_where_nothing_is_random(env_id):
    """Each episode on which R-max is not optimal makes a pair known: no more episodes than pairs.

    With value_bound at the optimum of the best state, what it goes for is never less than the
    best; an episode that meets nothing new is therefore as good as the best one.
    """
    model = transition_model(gym.make(env_id))
    plan = value_iteration(model, 0.99)
    bound = max(float(plan.values[model.reachable].max()), 0.0)
    agent = load_algorithm("r_max")(
        env=make_vec_env(env_id, seed=0), seed=0, known_after=1, value_bound=bound, tolerance=1e-9
    )
    n_pairs = int(model.reachable.sum()) * model.n_actions
    agent.learn(n_pairs * 20)
    greedy = np.eye(model.n_actions, dtype=bool)[agent.policy.q_table.argmax(axis=1)]
    assert value_iteration(model, 0.99, mask=greedy).start_value == pytest.approx(plan.start_value)


# --- what all of them keep to ---------------------------------------------------------------------

SETTINGS = {
    "dyna_q": {"outcomes_kept": 3, "skip_terminal_update": True},
    "dyna_q_plus": {"kappa": 0.01, "learning_rate": "sample_average"},
    "prioritized_sweeping": {
        "exploration": "boltzmann",
        "learning_rate": 0.5,
        "planning_steps": 1,
        "initial_q_std": 1.0,
    },
    "r_max": {"known_after": 3, "value_bound": 1.0},
}


def model_bytes(agent):
    return {name: array.tobytes() for name, array in agent.policy.model._asdict().items()}


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("name", NAMES)
def test_both_engines_end_in_the_same_bits(name, n_envs):
    """Also where they take turns."""
    ends = []
    for engines in (("interpreted",) * 2, ("compiled",) * 2, ("compiled", "interpreted")):
        agent = make(name, "FrozenLake-v1", n_envs, **SETTINGS[name])
        for engine in engines:
            agent.engine = engine
            agent.learn(700, reset_num_timesteps=False)
            assert agent.engine_in_use.startswith(engine)
        ends.append({**state_of(agent), **model_bytes(agent)})
    assert differences(ends[0], ends[1]) == differences(ends[0], ends[2]) == {}


def test_both_engines_are_masked_alike():
    ends = []
    for engine in ("interpreted", "compiled"):
        agent = make("dyna_q_plus", "envs:Warehouse-v0", 2, engine=engine, mask_actions=True)
        ends.append({**state_of(agent.learn(2000)), **model_bytes(agent)})
    assert differences(*ends) == {}


@pytest.mark.parametrize("name", NAMES)
def test_a_loaded_agent_goes_on_with_its_model(name, tmp_path):
    def env():
        return make_vec_env("FrozenLake-v1", 2, seed=3)

    algorithm = load_algorithm(name)
    agent = algorithm(env=env(), seed=1, **SETTINGS[name]).learn(600)
    agent.save(tmp_path / "agent")
    loaded = algorithm.load(tmp_path / "agent.zip", env=env())
    assert model_bytes(loaded) == model_bytes(agent)
    agent.set_env(env())
    for one in (agent, loaded):
        one.learn(600, reset_num_timesteps=False)
    assert model_bytes(loaded) == model_bytes(agent)
    assert loaded.policy.q_table.tobytes() == agent.policy.q_table.tobytes()
    assert loaded.policy.model.counts.sum() > 600 or name == "r_max"
    # And a policy alone.
    agent.policy.save(str(tmp_path / "policy"))
    alone = type(agent.policy).load(str(tmp_path / "policy"))
    assert all(np.array_equal(*pair) for pair in zip(alone.model, agent.policy.model, strict=True))


@pytest.mark.parametrize(
    ("name", "array", "value"),
    [
        *((name, "next_obs", 16) for name in NAMES),
        ("dyna_q", "next_obs", -1),
        ("dyna_q", "pairs", 64),
        ("dyna_q", "n_pairs", 65),
        ("dyna_q", "counts", -1),
        ("prioritized_sweeping", "queue", 64),
        ("prioritized_sweeping", "queue", 0),
        ("prioritized_sweeping", "place", NONE),
        ("prioritized_sweeping", "n_queued", 64),
        ("prioritized_sweeping", "behind", 3),
        ("prioritized_sweeping", "before", 3),
        ("prioritized_sweeping", "first_into", 3),
        ("r_max", "tallies", 2),
        ("r_max", "counts", 4),
        ("r_max", "states", 16),
        ("r_max", "n_states", 17),
    ],
)
def test_a_damaged_model_is_refused(name, array, value, tmp_path):
    """Compiled code would read and write beside it, or never come to an end."""
    agent = make(name, "FrozenLake-v1", **SETTINGS[name], engine="interpreted").learn(300)
    getattr(agent.policy, f"model_{array}").fill_(value)
    agent.save(tmp_path / "agent")
    with pytest.raises(ValueError, match=r"^holds no "):
        type(agent).load(tmp_path / "agent.zip")


def test_a_model_of_another_number_of_outcomes_is_refused(tmp_path):
    make("dyna_q", "FrozenLake-v1", engine="interpreted").save(tmp_path / "agent")
    with pytest.raises(ValueError, match=r"room for 1 outcomes of .* the settings ask for 3"):
        load_algorithm("dyna_q").load(tmp_path / "agent.zip", outcomes_kept=3)


def test_a_model_of_another_shape_is_refused():
    agent = make("dyna_q", "FrozenLake-v1", engine="interpreted")
    agent.policy.model_rewards = th.zeros(16, 4, 2, dtype=th.float64)
    with pytest.raises(ValueError, match=r"model_rewards must be of shape \(16, 4, 1\)"):
        agent.learn(10)


@pytest.mark.parametrize("kind", [ModelPolicy, DatedModelPolicy, CountedModelPolicy])
def test_the_largest_model_fits_into_a_file_that_is_read_again(kind):
    policy = kind(spaces.Discrete(1000), spaces.Discrete(4))
    most = policy._most_outcomes()
    policy.keep_outcomes(most)
    size = sum(array.nbytes for array in policy.buffers())
    per_outcome = sum(array[..., 0].nbytes for array in policy.buffers() if array.shape[-1] == most)
    # Numbers of which there is one are counted for each state.
    assert MOST_BYTES - per_outcome - 16_000 <= size <= MOST_BYTES < MAX_ARCHIVE_BYTES
    with pytest.raises(ValueError, match=f"at most {most} of each"):
        policy.keep_outcomes(most + 1)


@pytest.mark.parametrize(
    ("name", "arguments", "complaint"),
    [
        (
            "dyna_q",
            {"planning_steps": -1},
            "planning_steps must be a whole .* at least 0",
        ),
        ("dyna_q", {"planning_steps": 2.5}, "planning_steps must be a whole number .*, not 2.5"),
        (
            "dyna_q",
            {"outcomes_kept": 0},
            "outcomes_kept must be a whole .* at least 1",
        ),
        ("dyna_q", {"outcomes_kept": True}, "outcomes_kept must be a whole number .*, not True"),
        ("dyna_q", {"outcomes_kept": 10**7}, "at most 925212 of each"),
        ("dyna_q_plus", {"kappa": -0.1}, "kappa must be at least 0"),
        ("dyna_q_plus", {"kappa": float("inf")}, "kappa must be finite"),
        ("prioritized_sweeping", {"threshold": -1.0}, "threshold must be at least 0"),
        ("prioritized_sweeping", {"planning_steps": 1e9}, "planning_steps must be a whole number"),
        ("r_max", {"gamma": 1.0, "value_bound": 1.0}, "gamma must be below 1"),
        ("r_max", {"known_after": 0}, "known_after must be a whole number of at least 1, not 0"),
        ("r_max", {"known_after": 10**30}, "known_after must be at most 1000000000, not 1000"),
        ("r_max", {"tolerance": 0.0}, "tolerance must be above 0"),
    ],
)
def test_wrong_arguments(name, arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        load_algorithm(name)(env="FrozenLake-v1", **arguments)
