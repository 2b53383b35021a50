"""A training that is watched: what is kept of it is what the agent did, and it is not disturbed."""

from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from rich.console import Console
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.common.callbacks import BlockCallback
from pipeline import watching
from pipeline.agent_settings import resolved_spec
from pipeline.environments import make_training_env
from pipeline.errors import UserError
from pipeline.evaluation.exact import exact_evaluator
from pipeline.preparation import algorithm_kwargs, make_model
from pipeline.settings.hyperparams import read_hyperparams, split
from pipeline.train_spec import TrainSpec
from pipeline.training import carry_out, prepare, train
from pipeline.watching import NO_STATE, TERMINATED, TRUNCATED, TableRecorder

LAKE = "FrozenLake-v1"


class Corridor(gym.Env):
    """Cells in a row and one action, forward; each step has its reward; the last one is the end."""

    action_space = gym.spaces.Discrete(1)

    def __init__(self, rewards=(1.0, 2.0)):
        self.rewards = rewards
        self.observation_space = gym.spaces.Discrete(len(rewards) + 1)

    def reset(self, **options):
        super().reset(**options)
        self.cell = 0
        return 0, {}

    def step(self, action):
        self.cell += 1
        reward = self.rewards[self.cell - 1]
        return self.cell, reward, self.cell == len(self.rewards), False, {}


THREE_ONES = Corridor(rewards=(1.0, 1.0, 1.0))


def spec_of(env_id=LAKE, algo="qlearning", n_timesteps=300, settings=(), **fields):
    entry = {"n_timesteps": n_timesteps, **dict(settings)}
    common = {"seed": 3, "verbose": 0, "pictures": False, "eval_episodes": 5, "final_episodes": 5}
    return TrainSpec(algo, env_id, split(entry), entry, **{**common, **fields})


def watched(env, name="qlearning", n_timesteps=300, n_episodes=0, **settings):
    """An agent that was watched while it learnt, and what was kept."""
    recorder = TableRecorder(n_episodes)
    agent = load_algorithm(name)(env=env, seed=1, **settings).learn(n_timesteps, recorder)
    return agent, recorder


def test_two_episodes_worked_by_hand():
    """With step size and discount 1/2: targets 1, 2, then 1 + 1/2 = 1.5, 2."""
    halves = {"learning_rate": 0.5, "gamma": 0.5}
    _, recorder = watched(Corridor(), n_timesteps=9, n_episodes=2, **halves)
    moves, changes = recorder.moves.rows, recorder.changes.rows
    assert moves["target"].tolist() == [1.0, 2.0, 1.5, 2.0]
    assert moves["td_error"].tolist() == [1.0, 2.0, 1.0, 1.0]
    assert moves["obs"].tolist() == [0, 1, 0, 1]
    assert moves["next_obs"].tolist() == [1, 2, 1, 2]
    assert moves["reward"].tolist() == [1.0, 2.0, 1.0, 2.0]
    assert moves["episode_return"].tolist() == [1.0, 3.0, 1.0, 3.0]
    assert moves["episode"].tolist() == [0, 0, 1, 1]
    assert moves["end"].tolist() == [0, TERMINATED, 0, TERMINATED]
    assert changes["entry"].tolist() == [0, 1, 0, 1]
    assert changes["after"].tolist() == [0.5, 1.0, 1.0, 1.5]
    assert changes["step"].tolist() == [0, 1, 2, 3]
    assert recorder.steps.rows["timesteps"].tolist() == [1, 2, 3, 4]
    assert recorder.steps.rows["learning_rate"].tolist() == [0.5] * 4
    # The two episodes are over: nothing was left out.
    assert (recorder.is_full, recorder.is_cut) == (True, False)


@pytest.mark.parametrize("engine", ["compiled", "interpreted"])
def test_targets_are_those_of_the_rule_to_the_last_bit(engine):
    agent, recorder = watched(LAKE, n_timesteps=2000, engine=engine, learning_rate=0.3)
    assert agent.engine_in_use.startswith(engine)
    table = recorder.initial["q_tables"].copy()[0]
    changes = {row["step"]: row for row in recorder.changes.rows}
    assert len(changes) == len(recorder.changes)  # one entry at a time
    for move in recorder.moves.rows:
        follows = 0.0 if move["end"] == TERMINATED else 0.99 * table[move["next_obs"]].max()
        assert move["target"] == move["reward"] + follows
        at = move["obs"], move["action"]
        assert move["td_error"] == move["target"] - table[at]
        after = table[at] + 0.3 * move["td_error"]
        if after != table[at]:
            change = changes[move["step"]]
            assert (change["entry"], change["after"]) == (at[0] * 4 + at[1], after)
            table[at] = after
    assert np.array_equal(table, agent.policy.q_table)
    assert table.any()


@pytest.mark.parametrize(
    ("name", "n_envs", "engine"), [("sarsa", 1, "compiled"), ("double_qlearning", 3, "interpreted")]
)
def test_who_is_watched_learns_the_same(name, n_envs, engine):
    ended = []
    for recorder in (None, TableRecorder(4)):
        env = make_vec_env(LAKE, n_envs, seed=3)
        agent = load_algorithm(name)(env=env, seed=1, engine=engine).learn(900, recorder)
        assert agent.engine_in_use.startswith(engine)
        ended.append((agent.policy.q_tables.numpy().tobytes(), agent.rng.bit_generator.state))
    assert ended[0] == ended[1]
    assert recorder.is_full
    # It goes on to the end of the step in which the fourth episode ends.
    assert recorder.moves.rows["end"].astype(bool).sum() >= 4
    assert len(recorder.moves) == n_envs * len(recorder.steps)
    assert recorder.moves.rows["env"].tolist() == [*range(n_envs)] * len(recorder.steps)


def test_where_nothing_is_learnt_there_is_no_target():
    # Some episodes end in a hole.
    _, recorder = watched(LAKE, n_timesteps=200, skip_terminal_update=True, initial_q=1.0)
    moves = recorder.moves.rows
    ends = moves["end"] == TERMINATED
    assert ends.any()
    assert np.array_equal(np.isnan(moves["target"]), ends)
    assert not np.isin(moves["step"][ends], recorder.changes.rows["step"]).any()


def test_an_episode_that_is_cut_off_still_bootstraps():
    env = gym.make(LAKE, max_episode_steps=3, is_slippery=False)
    _, recorder = watched(env, n_timesteps=60, initial_q=1.0, gamma=0.5)
    cut = recorder.moves.rows[recorder.moves.rows["end"] == TRUNCATED]
    assert len(cut) > 5
    # Where its best next value is still the first one.
    assert 0.5 in cut["target"]


def test_along_traces_several_entries_move_by_one_error():
    """Step size 1/2, discount 1, lambda 1/2: errors 1, 1, 1; traces 1, then 1/2 and 1, ..."""
    halves = {"learning_rate": 0.5, "gamma": 1.0, "trace_decay": 0.5}
    _, recorder = watched(THREE_ONES, "sarsa_lambda", n_timesteps=3, **halves)
    moves, changes = recorder.moves.rows, recorder.changes.rows
    assert (moves["target"].tolist(), moves["td_error"].tolist()) == ([1.0] * 3, [1.0] * 3)
    assert changes["step"].tolist() == [0, 1, 1, 2, 2, 2]
    assert changes["entry"].tolist() == [0, 0, 1, 0, 1, 2]
    assert changes["after"].tolist() == [0.5, 0.75, 0.5, 0.875, 0.75, 0.5]


def test_of_several_steps_the_target_is_told_where_there_is_one():
    """Two rewards of 1 make a target of 2; at the end two entries are moved, to 2 and to 1."""
    settings = {"n_steps": 2, "learning_rate": 0.5, "gamma": 1}
    _, recorder = watched(THREE_ONES, "n_step_sarsa", n_timesteps=3, **settings)
    moves, changes = recorder.moves.rows, recorder.changes.rows
    for name in ("target", "td_error"):
        assert np.array_equal(moves[name], [np.nan, 2.0, np.nan], equal_nan=True)
    assert changes["step"].tolist() == [1, 2, 2]
    assert changes["entry"].tolist() == [0, 1, 2]
    assert changes["after"].tolist() == [1.0, 1.0, 0.5]


def test_whole_episodes_move_at_their_end():
    _, recorder = watched(THREE_ONES, "monte_carlo", n_timesteps=6, learning_rate=0.5, gamma=1.0)
    changes = recorder.changes.rows
    assert changes["step"].tolist() == [2, 2, 2, 5, 5, 5]
    assert changes["after"].tolist() == [1.5, 1.0, 0.5, 2.25, 1.5, 0.75]
    assert np.isnan(recorder.moves.rows["target"]).all()


def test_a_table_that_diverges_is_kept_to_the_last_bit_and_nan_moves_once():
    huge = {"learning_rate": 1e200, "gamma": 1.0, "initial_q": -1e200}
    with np.errstate(all="ignore"):
        agent, recorder = watched(Corridor(), n_timesteps=40, **huge)
    table = recorder.initial["q_tables"].reshape(-1).copy()
    changes = recorder.changes.rows
    table[changes["entry"]] = changes["after"]
    assert table.tobytes() == agent.policy.q_table.tobytes()
    assert np.isnan(changes["after"]).sum() == np.isnan(table).sum() > 0
    assert np.isinf(changes["after"]).any()


def test_there_is_an_end_to_what_is_kept(monkeypatch):
    monkeypatch.setattr(watching, "MOVES_UNASKED", 50)
    monkeypatch.setattr(watching, "MOST_MOVES", 80)
    for n_episodes, kept in ((0, 50), (10_000, 80)):
        _, recorder = watched(LAKE, n_timesteps=200, n_episodes=n_episodes)
        assert (len(recorder.moves), recorder.is_cut) == (kept, True)
    monkeypatch.setattr(watching, "MOST_CHANGES", 9)
    _, recorder = watched(Corridor(), n_timesteps=50)
    assert len(recorder.changes) == 10


@pytest.mark.parametrize(
    ("env_id", "algo"), [("SegmentBandit-v0", "epsilon_greedy"), ("LinearBandit-v0", "linucb")]
)
def test_bandits_are_watched_in_their_tables(env_id, algo):
    agent, recorder = watched(f"envs:{env_id}", algo, n_timesteps=20)
    assert np.isnan(recorder.moves.rows["target"]).all()
    knows_contexts = env_id == "SegmentBandit-v0"
    assert recorder.has_actions == knows_contexts
    assert (recorder.moves.rows["obs"][0] == NO_STATE) != knows_contexts
    for number, name in enumerate(recorder.names):
        table = recorder.initial[name].reshape(-1).copy()
        for change in recorder.changes.rows:
            if change["table"] == number:
                table[change["entry"]] = change["after"]
        assert np.array_equal(table, getattr(agent.policy, name).numpy().reshape(-1))


def episodes_of(folder):
    rows = (folder / "0.monitor.csv").read_text().splitlines()[2:]
    return [row.split(",")[:2] for row in rows]


def done(spec):
    training = prepare(spec, Console(quiet=True), {}, "")
    return training, carry_out(training)


SMALL_PPO = {"n_steps": 32, "batch_size": 32}
SMALL_A2C = {"n_steps": 32}
SMALL_DQN = {"learning_starts": 50, "buffer_size": 200, "train_freq": 8, "gradient_steps": 2}


@pytest.mark.parametrize(
    ("algo", "settings"),
    [
        ("qlearning", {}),
        ("dqn", {**SMALL_DQN, "engine": "compiled", "train_freq": [2, "episode"]}),
        ("double_dqn", {**SMALL_DQN, "engine": "compiled", "n_envs": 2}),
        ("ppo", SMALL_PPO),
        ("a2c", {"engine": "compiled"}),
    ],
)
def test_a_run_that_is_watched_leaves_the_same_agent(tmp_path, algo, settings):
    spec = spec_of(algo=algo, settings=settings, log_folder=tmp_path)
    alone = train(spec, Console(quiet=True), {}, "")
    training, outcome = done(replace(spec, watch_learning=tmp_path / "page.html"))
    assert outcome.engine == alone.engine
    one, other = (
        load_algorithm(algo).load(run.run.model_path).policy.state_dict()
        for run in (alone, outcome)
    )
    assert all(one[name].numpy().tobytes() == other[name].numpy().tobytes() for name in one)
    one, other = (episodes_of(run.run.path) for run in (alone, outcome))
    assert one == other
    one, other = (np.load(run.run.evaluations_path) for run in (alone, outcome))
    assert one["results"].tobytes() == other["results"].tobytes()
    if algo == "qlearning":
        assert len(training.watch.steps) == 300
        return
    assert len(training.watch.moments) > 4


class Updates(BlockCallback):
    """Where the library's agents have learnt something: their count, steps and loss as logged."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_rollout_start(self):
        log = self.model.logger.name_to_value
        if self.model._n_updates and (not self.seen or self.model._n_updates != self.seen[-1][0]):
            loss = log.get("train/loss", log.get("train/policy_loss", np.nan))
            self.seen.append((self.model._n_updates, self.model.num_timesteps, loss))

    def _on_step(self):
        return True


@pytest.mark.parametrize(
    ("algo", "settings", "steps", "engine"),
    [
        ("ppo", SMALL_PPO, range(0, 321, 32), "compiled"),
        ("dqn", SMALL_DQN, [0, *range(56, 305, 8)], "library"),
        ("dqn", SMALL_DQN, [0, *range(56, 305, 8)], "compiled"),
        ("a2c", SMALL_A2C, range(0, 321, 32), "library"),
    ],
)
def test_of_a_network_there_is_a_map_at_each_update(tmp_path, algo, settings, steps, engine):
    settings = {**settings, "engine": engine}
    spec = spec_of(algo=algo, settings=settings, log_folder=tmp_path)
    spec = replace(spec, watch_learning=tmp_path / "page.html")
    training = prepare(spec, Console(quiet=True), {}, "")
    heard = Updates()
    training.callback.callbacks.append(heard)
    outcome = carry_out(training)
    training.watch.finish()
    rows = training.watch.moments.rows
    assert (rows["timesteps"].tolist(), training.watch.n_units) == ([*steps], len(steps) - 1)
    assert rows["number"].tolist() == [*range(len(steps))]
    # The last one is learnt after the last rollout.
    assert heard.seen[-1][1] == rows["timesteps"][-2]
    loss = "policy_loss" if algo == "a2c" else "loss"
    assert rows[loss][1:-1].tolist() == [loss for _, _, loss in heard.seen]
    assert rows[loss][-1] == training.model.logger.name_to_value[f"train/{loss}"]
    assert np.isnan(rows["value_loss"][1:]).any() == (algo == "dqn")
    assert np.isnan(rows[0][loss])
    # What the start is worth at the end is the return that was computed of the final agent.
    at_start = rows["values"] @ training.watch.evaluator.model.initial
    assert at_start[-1] == pytest.approx(outcome.final.mean_return, abs=1e-12)
    assert rows["exploration"][0] == (1.0 if algo == "dqn" else pytest.approx(np.nan, nan_ok=True))
    lengths = [float(row[0]) for row in episodes_of(outcome.run.path)]
    assert rows["training_return"][-1] == pytest.approx(np.mean(lengths[-100:]))


def test_of_many_maps_every_second_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(watching, "MOST_MAPS", 4)
    spec = spec_of(algo="ppo", settings=SMALL_PPO, log_folder=tmp_path)
    training, _ = done(replace(spec, watch_learning=tmp_path / "page.html"))
    training.watch.finish()
    training.watch.finish()
    rows = training.watch.moments.rows
    # Ten updates; the last one is kept though it is none of every fourth.
    assert rows["number"].tolist() == [0, 4, 8, 10]
    assert rows["timesteps"].tolist() == [0, 128, 256, 320]
    assert (training.watch.stride, training.watch.n_units) == (4, 10)


def test_what_cannot_be_shown_is_refused_before_anything_is_trained(tmp_path, monkeypatch):
    page = {"log_folder": tmp_path / "logs", "watch_learning": tmp_path / "page.html"}
    small = {"learning_starts": 50, "buffer_size": 200}
    with pytest.raises(UserError, match="dqn on CartPole-v1 has neither"):
        done(spec_of("CartPole-v1", "dqn", settings=small, **page))
    with pytest.raises(UserError, match="random on FrozenLake-v1 has neither"):
        done(spec_of(algo="random", **page))
    with pytest.raises(UserError, match="--watch-episodes is for agents with tables: dqn"):
        done(spec_of(algo="dqn", settings=small, watch_episodes=3, **page))
    monkeypatch.setattr(watching, "MOST_ENTRIES", 63)
    with pytest.raises(UserError, match=r"up to 63 entries; those of qlearning on Froz.* have 64"):
        done(spec_of(**page))
    assert not Path(page["log_folder"]).exists()


@pytest.mark.parametrize("env_id", ["FrozenLake-v1", "CliffWalking-v1"])
def test_what_is_played_covers_the_rise_of_the_greedy_policys_return(env_id):
    """Replayed from the records: it is low where the window begins, and high where it ends."""
    settings = read_hyperparams("qlearning", env_id) | {"n_timesteps": 60_000}
    settings.pop("n_episodes", None)
    spec = resolved_spec(settings, algo="qlearning", env_id=env_id, seed=0)
    exact, env = exact_evaluator(spec), make_training_env(spec, None)
    agent, recorder = make_model(spec, None, env, algorithm_kwargs(spec)), TableRecorder(0, exact)
    agent.learn(60_000, recorder)
    begin, end = recorder.window()
    table = recorder.initial["q_tables"].copy()
    returns, changes = {}, recorder.changes.rows
    for step in sorted({*range(0, len(recorder.steps) + 1, 50), begin, end}):
        now = changes[changes["step"] < step]
        table.reshape(-1)[now["entry"]] = now["after"]
        agent.policy.q_tables.copy_(th.from_numpy(table))
        returns[step] = exact(agent).mean_return
    low, high = returns[0], max(returns.values())
    assert high >= 0.9 * exact.yardstick.optimum if high > 0 else high > low
    assert returns[begin] <= low + 0.35 * (high - low)
    assert max(value for step, value in returns.items() if begin <= step <= end) >= (
        low + 0.9 * (high - low)
    )
    assert 5000 <= end - begin <= 20_000
    # It begins with an episode.
    before = recorder.moves.rows[recorder.moves.rows["step"] == begin - 1]
    assert begin == 0 or before["end"][0] != 0
