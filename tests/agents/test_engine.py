"""The compiled engine ends in the same bits as the interpreted one."""

import csv
import gc
import itertools
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import ClipReward, PassiveEnvChecker
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule

import envs  # noqa: F401  # registers the environments
from agents import ALGORITHMS, load_algorithm
from agents.common.callbacks import BlockCallback, EpisodeBudget, Horizon, calls_until_multiple
from agents.common.schedules import ExponentialSchedule
from envs.grid import GridWorld
from envs.wrappers import DiscretizeObservation, FlattenToDiscrete, ScaleReward, TerminationReward

ENGINES = ("interpreted", "compiled")

discretize = partial(
    DiscretizeObservation,
    bins=50,
    low=[-0.41887903, -0.87266463],
    high=[0.41887903, 0.87266463],
    dims=[2, 3],
)

ENVS = {
    "Warehouse": ("envs:Warehouse-v0", {}, None),
    "slippery Warehouse": ("envs:Warehouse-v0", {"slip": 0.2, "random_start": True}, None),
    "MineMaze": ("envs:MineMaze-v0", {}, None),
    "FrozenLake": ("FrozenLake-v1", {}, None),
    "FrozenLake8x8": ("FrozenLake8x8-v1", {}, None),
    "CliffWalking": ("CliffWalking-v1", {}, None),
    "Taxi": ("Taxi-v4", {}, None),
    "CartPole": ("CartPole-v1", {}, discretize),
}
for spec in list(gym.registry.values()):
    # A grid world that is not among them yet is trained on as it is.
    if str(spec.entry_point).startswith("envs.") and f"envs:{spec.id}" not in str(ENVS):
        env = gym.make(spec.id) if spec.id != "ReplayBandit-v0" else None
        if env is not None and isinstance(env.unwrapped, GridWorld):
            ENVS[spec.id] = (f"envs:{spec.id}", {}, None)
EXPLORATION = {
    "linear": {},
    "constant": {"exploration_decay": "constant", "exploration_initial_eps": 0.1},
    "exponential": {"exploration_decay": "exponential", "exploration_fraction": 0.7},
    "boltzmann": {"exploration": "boltzmann", "temperature": LinearSchedule(5.0, 0.2, 0.8)},
    "gaussian": {"exploration": "gaussian_noise", "noise_std": 20.0},
}
STEP_SIZES = {
    "constant": 0.2,
    "linear": LinearSchedule(0.8, 0.05, 0.9),
    "exponential": ExponentialSchedule(0.8, 0.01),
    "average": "sample_average",
}
# Those that learn a model or go by bonuses are in test_learnt_models and test_optimism.
ELSEWHERE = {"dyna_q", "dyna_q_plus", "prioritized_sweeping", "r_max", "qlearning_ucb"}
FACTORS = (
    tuple(ENVS),
    tuple(
        name
        for name, entry in ALGORITHMS.items()
        if entry.family == "tabular" and name not in ELSEWHERE
    ),
    tuple(EXPLORATION),
    tuple(STEP_SIZES),
    ("random", "first"),
    (1, 8),
)
STEPS = 6_000


# Actions without probabilities are nothing to these; weighted means have a step size of their own.
NEEDING_PROBABILITIES = {"expected_sarsa", "n_step_tree_backup", "off_policy_monte_carlo"}
OTHER_STEP_SIZES = {"constant", "linear", "exponential"}
# They differ in what they remember, for which these environments are enough.
REMEMBERING = {
    name
    for name in FACTORS[1]
    if name not in ("qlearning", "sarsa", "expected_sarsa", "double_qlearning")
}
ENOUGH_ENVS = {"slippery Warehouse", "FrozenLake"}


def allowed(case):
    """Whether these levels of some factors can be combined, and are to be."""
    levels = set(case)
    return not (
        ("gaussian" in levels and levels & NEEDING_PROBABILITIES)
        or ("off_policy_monte_carlo" in levels and levels & OTHER_STEP_SIZES)
        or (levels & REMEMBERING and levels & (set(ENVS) - ENOUGH_ENVS))
    )


def pairs(case):
    return set(itertools.combinations(enumerate(case), 2))


def covering_cases():
    """Few combinations, in which every two levels of two factors meet."""
    candidates = [case for case in itertools.product(*FACTORS) if allowed(case)]
    pairs_of = {case: pairs(case) for case in candidates}
    missing = set().union(*pairs_of.values())
    chosen = []
    while missing:
        best = max(candidates, key=lambda case: len(pairs_of[case] & missing))
        chosen.append(best)
        missing -= pairs_of[best]
    return chosen


CASES = covering_cases()


def make(name, env_id, n_envs=1, env_kwargs=None, wrapper=None, folder=None, **kwargs):
    env = make_vec_env(
        env_id,
        n_envs,
        seed=3,
        env_kwargs=env_kwargs,
        wrapper_class=wrapper,
        monitor_dir=None if folder is None else str(folder),
    )
    return load_algorithm(name)(env=env, seed=1, **kwargs)


def state_of(model):
    """Everything that what comes next depends on, and everything that statistics are made of."""
    state = {
        "tables": model.policy.q_tables.numpy().tobytes(),
        "visits": model.policy.visit_counts.numpy().tobytes(),
        "generator": model.rng.bit_generator.state,
        "action generator": model.action_space.np_random.bit_generator.state,
        "observations": model._last_obs.tolist(),
        "episode starts": model._last_episode_starts.tolist(),
        "pending actions": model._next_actions.tolist(),
        "memory": [array.tobytes() for array in model._memory],
        "steps": model.num_timesteps,
        "total": model._total_timesteps,
        "episodes": model._episode_num,
        "updates": model._n_updates,
        "progress": model._current_progress_remaining,
        "error": model.mean_td_error,
        "returns": [(info["r"], info["l"]) for info in model.ep_info_buffer],
        "successes": [bool(success) for success in model.ep_success_buffer],
    }
    for i, env in enumerate(model.env.envs):
        state.update({f"env {i} {key}": value for key, value in env_state(env).items()})
    return state


def env_state(env):
    base = env.unwrapped
    state = {
        "generator": base.np_random.bit_generator.state,
        "state": base.s if hasattr(base, "s") else base.state.tobytes(),
    }
    for name in ("episode_returns", "episode_lengths", "rewards", "total_steps", "needs_reset"):
        state[name] = env.get_wrapper_attr(name)
    if env.has_wrapper_attr("_elapsed_steps"):
        state["elapsed"] = env.get_wrapper_attr("_elapsed_steps")
    return state


def rows_of(path):
    """Return and length of each episode that Monitor has written."""
    return [line.split(",")[:2] for line in path.read_text().splitlines()]


def differences(first, second):
    assert first.keys() == second.keys()
    return {key: (first[key], second[key]) for key in first if first[key] != second[key]}


def assert_engines_agree(make_model, train):
    """The state after training is the same on either engine; returns the two models."""
    models = []
    for engine in ENGINES:
        model = make_model(engine=engine)
        train(model)
        assert model.engine_in_use.startswith(engine)
        model.env.close()
        models.append(model)
    states = [state_of(model) for model in models]
    assert differences(*states) == {}
    assert np.any(models[0].policy.visit_counts.numpy())
    return models


# --- every combination of two choices ------------------------------------------------------------


def test_cases_cover_every_pair():
    met = set().union(*(pairs(case) for case in CASES))
    for (i, first), (j, second) in itertools.combinations(enumerate(FACTORS), 2):
        for levels in itertools.product(first, second):
            assert (((i, levels[0]), (j, levels[1])) in met) == allowed(levels)
    assert len(CASES) * STEPS >= 250_000


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_same_bits(case, tmp_path):
    env, name, exploration, step_size, ties, n_envs = case
    env_id, env_kwargs, wrapper = ENVS[env]

    def make_model(engine):
        return make(
            name,
            env_id,
            n_envs,
            env_kwargs,
            wrapper,
            tmp_path / engine,
            engine=engine,
            learning_rate=STEP_SIZES[step_size],
            tie_breaking=ties,
            **EXPLORATION[exploration],
        )

    assert_engines_agree(make_model, lambda model: model.learn(STEPS))
    for i in range(n_envs):
        rows, compiled_rows = (
            rows_of(tmp_path / engine / f"{i}.monitor.csv")[1:] for engine in ENGINES
        )
        assert rows == compiled_rows
        assert rows[0] == ["r", "l"]


# --- wrappers, budgets, logs ---------------------------------------------------------------------


def both_shaped(env):
    return TerminationReward(ClipReward(ScaleReward(env, 0.1), -0.5, 0.9), -3.3)


@pytest.mark.parametrize(
    "wrapper",
    [
        partial(ScaleReward, scale=0.01),
        partial(TerminationReward, reward=-7.7),
        both_shaped,
        FlattenToDiscrete,
        PassiveEnvChecker,
    ],
)
@pytest.mark.parametrize("env", ["slippery Warehouse", "Taxi"])
def test_wrappers_are_folded_in(env, wrapper):
    env_id, env_kwargs, _ = ENVS[env]
    make_model = partial(make, "sarsa", env_id, 2, env_kwargs, wrapper, learning_rate=0.3)
    shaped, _ = assert_engines_agree(make_model, lambda model: model.learn(4000))
    plain = make("sarsa", env_id, 2, env_kwargs, learning_rate=0.3).learn(4000)
    same = np.array_equal(shaped.policy.q_table, plain.policy.q_table)
    assert same == (wrapper in (FlattenToDiscrete, PassiveEnvChecker))


@pytest.mark.parametrize("decay", ["linear", "exponential"])
@pytest.mark.parametrize(("name", "n_envs"), [("qlearning", 1), ("sarsa", 3)])
def test_schedules_by_episodes(decay, name, n_envs):
    make_model = partial(
        make, name, "FrozenLake-v1", n_envs, exploration_decay=decay, exploration_fraction=0.9
    )
    models = assert_engines_agree(
        make_model, lambda model: model.learn(10**9, callback=EpisodeBudget(500))
    )
    for model in models:
        assert 500 <= model._episode_num < 500 + n_envs
        assert model._current_progress_remaining == pytest.approx(0.0, abs=n_envs / 500)


@pytest.mark.parametrize("n_envs", [1, 4])
def test_stopping_after_some_episodes(n_envs):
    # The callback counts episodes for each environment.
    models = assert_engines_agree(
        partial(make, "double_qlearning", "FrozenLake-v1", n_envs),
        lambda model: model.learn(10**9, callback=StopTrainingOnMaxEpisodes(60)),
    )
    assert 60 * n_envs <= models[0]._episode_num < 61 * n_envs


@pytest.mark.parametrize(("n_envs", "log_interval"), [(1, 1), (1, 7), (4, 3), (4, 10), (2, None)])
def test_log_records_are_the_same(n_envs, log_interval, tmp_path):
    def train(model):
        model.set_logger(configure(str(tmp_path / model.engine), ["csv"]))
        model.learn(3000, log_interval=log_interval)
        model.logger.close()

    assert_engines_agree(partial(make, "sarsa", "FrozenLake-v1", n_envs), train)
    records = []
    for engine in ENGINES:
        with (tmp_path / engine / "progress.csv").open() as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            del row["time/fps"], row["time/time_elapsed"]
        records.append(rows)
    assert records[0] == records[1]
    assert (len(records[0]) > 20) == (log_interval is not None)


# --- changing engines ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["qlearning", "sarsa"])
@pytest.mark.parametrize("env", ["slippery Warehouse", "MineMaze", "CartPole"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_engines_may_change_between_two_calls(name, env, n_envs):
    env_id, env_kwargs, wrapper = ENVS[env]
    states = []
    for engines in itertools.product(ENGINES, repeat=3):
        model = make(name, env_id, n_envs, env_kwargs, wrapper)
        for engine in engines:
            model.engine = engine
            # Neither call ends where an episode does.
            model.learn(700, reset_num_timesteps=False)
        states.append(state_of(model))
    for state in states[1:]:
        assert differences(states[0], state) == {}
    assert states[0]["steps"] >= 2100


def test_what_follows_without_an_agent_is_the_same():
    played = []
    for engine in ENGINES:
        model = make("sarsa", "envs:Warehouse-v0", 2, {"slip": 0.3}, engine=engine).learn(1111)
        steps = [model.env.step(np.array([0, 3])) for _ in range(1200)]
        played.append([[part.tolist() for part in step[:3]] for step in steps])
    assert played[0] == played[1]


class Reseeding(BlockCallback):
    """Seeds the agent anew in the middle of a training, and leaves the old generator to nobody."""

    def horizon(self):
        return Horizon(calls=calls_until_multiple(self.n_calls, 500))

    def _on_step(self):
        if self.n_calls == 500:
            self.model.rng = np.random.default_rng(7)
            gc.collect()
        return True


@pytest.mark.parametrize("name", ["qlearning", "double_qlearning"])
def test_an_agent_that_is_seeded_anew_draws_from_its_new_generator(name):
    models = [
        make(name, "FrozenLake-v1", engine=engine).learn(1000, callback=Reseeding())
        for engine in ENGINES
    ]
    assert [model.engine_in_use[:8] for model in models] == ["interpre", "compiled"]
    assert not differences(*map(state_of, models))
    plain = make(name, "FrozenLake-v1", engine="compiled").learn(1000)
    assert not np.array_equal(plain.policy.q_table, models[1].policy.q_table)


def test_a_rule_that_is_not_compiled_is_named():
    with pytest.raises(TypeError, match=r"Plain.next_value is called by compiled code: put @inl"):

        class Plain(load_algorithm("qlearning")):
            def next_value(agent, env, progress, table):  # noqa: N805
                return 0.0
