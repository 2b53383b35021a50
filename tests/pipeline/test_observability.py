"""The yardstick where observations hide the state, and agents judged by all histories."""

import numpy as np
import pytest

import pipeline.evaluation.histories
from agents import load_algorithm
from pipeline.environments import make_evaluation_env
from pipeline.evaluation.exact import evaluator_of_single, exact_evaluator
from pipeline.evaluation.histories import by_histories, world_of_memory
from pipeline.evaluation.sampled import evaluate
from pipeline.evaluation.yardstick import HiddenState, Yardstick, with_memory
from tests.pipeline.short_runs import LAKE, agent_of, spec_of, trained

CORRIDOR, TIGER = "envs:ShortCorridor-v0", "envs:Tiger-v0"
BEST_OF_CORRIDOR = -(6 + 4 * np.sqrt(2))
SHORT = {"n_steps": 16, "batch_size": 16}
STACKED = {"env_wrapper": "envs.wrappers.OneHotObservation", "frame_stack": 2}


def yardstick_of(algo, env_id, entry=None):
    return exact_evaluator(spec_of(algo, env_id, entry)).yardstick


# --- the scale -----------------------------------------------------------------------------------


def test_agents_without_memory_are_measured_by_the_best_of_their_kind():
    yardstick = yardstick_of("qlearning", CORRIDOR)
    assert yardstick.optimum == pytest.approx(BEST_OF_CORRIDOR)
    assert yardstick.at_least is None
    figures = yardstick.figures(BEST_OF_CORRIDOR)
    assert figures["score"] == pytest.approx(1)
    assert (figures["full_optimum"], figures["memory_optimum"]) == (-3, -3)
    assert figures["measured_by"] == "observation"
    # Without a limit, p = 1/2 takes (4 - 1) / (1/4) steps; of 1000 the rest is nothing.
    assert yardstick.baseline == pytest.approx(-12)


def test_figures_are_put_on_the_scale_of_memory_and_only_where_that_differs():
    figures = {"mean_return": -11.0, **yardstick_of("qlearning", CORRIDOR).figures(-11.0)}
    wider = with_memory(figures)
    assert (wider["optimum"], wider["measured_by"]) == (-3, "memory")
    assert wider["score"] == pytest.approx(1 / 9)
    assert wider["gap"] == pytest.approx(8)
    assert with_memory(wider) == wider
    plain = {"mean_return": 0.5, **yardstick_of("qlearning", LAKE).figures(0.5)}
    assert with_memory(plain) is plain
    assert "full_optimum" not in plain


def test_a_bracket_on_the_scale_of_memory_has_both_of_its_ends():
    hidden = HiddenState(full_optimum=1.0, memory_optimum=(0.7, 0.9), with_memory=False)
    found = Yardstick(0.6, 0.2, at_least=0.4, hidden=hidden)
    wider = with_memory({"mean_return": 0.5, **found.figures(0.5)})
    assert (wider["optimum_at_least"], wider["optimum"]) == (0.7, 0.9)
    assert wider["score"] == pytest.approx((0.5 - 0.2) / (0.9 - 0.2))
    assert wider["score_at_most"] == pytest.approx((0.5 - 0.2) / (0.7 - 0.2))


@pytest.mark.parametrize(
    ("env_id", "entry"),
    [
        (LAKE, {}),
        ("envs:Warehouse-v0", {"env_kwargs": {"observation": "position"}}),
        (CORRIDOR, {"env_kwargs": {"max_episode_steps": 1}}),
    ],
)
def test_where_nothing_is_lost_by_observing_the_scale_stays(env_id, entry):
    evaluator = exact_evaluator(spec_of("qlearning", env_id, entry))
    assert evaluator.scale is evaluator.yardstick.hidden is None


def test_the_note_tells_what_chance_could_do():
    scale = exact_evaluator(spec_of("qlearning", CORRIDOR)).scale
    assert scale.note == (
        "the best policy without memory is random here and returns -11.66; always the same action "
        "at an observation, as in evaluations, at most -1000.00"
    )


def test_no_discounted_optimum_is_told_where_observations_hide_the_state():
    """To listen for all ten steps; whoever sees the state earns 95.62."""
    evaluator = exact_evaluator(spec_of("qlearning", TIGER))
    assert evaluator.scale.note is None
    agent = load_algorithm("qlearning")(env=TIGER, gamma=0.99, tie_breaking="first")
    found = evaluator.other_returns(agent)
    assert found.discounted_return == pytest.approx(-(1 - 0.99**10) / 0.01)
    assert found.discounted_optimum is None


# --- histories -----------------------------------------------------------------------------------


class Counting:
    """Counts readings of the tiger, and opens a door at a difference of two."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        count = np.zeros((1, len(observation), 1)) if state is None else state[0].copy()
        count[:, np.asarray(episode_start)] = 0
        count[0, observation == 0] = 0
        count[0, observation == 1] += 1
        count[0, observation == 2] -= 1
        actions = np.where(count[0, :, 0] >= 2, 2, np.where(count[0, :, 0] <= -2, 1, 0))
        return actions, (count,)


class ByTime:
    """Does one thing after the other."""

    def __init__(self, actions):
        self.actions = np.array(actions)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        time = np.zeros((1, len(observation), 1), int) if state is None else state[0]
        return self.actions[np.minimum(time[0, :, 0], len(self.actions) - 1)], (time + 1,)


def worth(agent, env_id, **env_kwargs):
    spec = spec_of("ppo_lstm", env_id, {"env_kwargs": env_kwargs} if env_kwargs else {})
    return by_histories(spec, agent, evaluator_of_single(spec))


def test_a_walk_by_the_clock_leaves_the_corridor_in_three_steps():
    found = worth(ByTime([1, 0, 1]), CORRIDOR)
    assert (found.mean_return, found.exact_std, found.mean_length) == (-3, 0, 3)
    assert found.success_rate == 1
    assert found.summary()["score"] == 1
    # The second step goes back, and so on for ever.
    assert worth(ByTime([1, 1, 1]), CORRIDOR).mean_return == -1000


def test_who_counts_readings_reaches_the_optimum_of_memory():
    # By hand: after two readings that agree the door is right in .7225 of all cases and wrong in
    # .0225; else there are three steps of listening.
    found = worth(Counting(), TIGER, max_episode_steps=3)
    assert found.mean_return == pytest.approx(2.72)
    shares, returns = np.array([0.7225, 0.0225, 0.255]), np.array([8.0, -102.0, -3.0])
    assert found.exact_std == pytest.approx(np.sqrt(shares @ (returns - 2.72) ** 2))
    assert found.summary()["score"] == pytest.approx(1)
    assert found.mean_length == 3


def test_histories_that_an_agent_does_not_tell_apart_are_one(monkeypatch):
    # Ten steps: 2^10 sequences of sounds and more, but few counts.
    monkeypatch.setattr(pipeline.evaluation.histories, "MOST_HISTORIES", 10)
    found = worth(Counting(), TIGER)
    # By hand, by how much more often the tiger was heard where it is; opening begins anew.
    total, counts = 0.0, {0: 1.0}
    for _ in range(10):
        after = {}
        for count, chance in counts.items():
            if abs(count) == 2:
                total += chance * (10 if count == 2 else -100)
                after[0] = after.get(0, 0.0) + chance
                continue
            total -= chance
            for step, share in ((1, 0.85), (-1, 0.15)):
                after[count + step] = after.get(count + step, 0.0) + chance * share
        counts = after
    assert found.mean_return == pytest.approx(total)
    assert found.mean_return < found.yardstick.optimum == pytest.approx(9.438, abs=1e-3)


def test_all_histories_say_what_many_episodes_say():
    memory = {**SHORT, "policy_kwargs": {"lstm_hidden_size": 4}}
    spec = spec_of("ppo_lstm", TIGER, {**memory, "env_kwargs": {"max_episode_steps": 8}})
    env = make_evaluation_env(spec, 8)
    agent = agent_of("ppo_lstm", env, device="cpu", **memory).learn(32)
    exact = by_histories(spec, agent, world_of_memory(spec, agent))
    sampled = evaluate(agent, env, 400, seed=0)
    error = exact.exact_std / np.sqrt(400)
    assert abs(sampled.mean_return - exact.mean_return) <= 4 * error + 1e-6
    assert sampled.std_return == pytest.approx(exact.exact_std, rel=0.2, abs=1e-6)
    assert sampled.mean_length == pytest.approx(exact.mean_length, rel=0.05)


def test_runs_say_by_which_scale_they_are_measured(tmp_path):
    outcome = trained("ppo_lstm", TIGER, SHORT, n_timesteps=32, log_folder=tmp_path)
    assert outcome.final.is_exact
    assert outcome.run.read_info()["final"]["measured_by"] == "memory"
    plain = trained("qlearning", TIGER, n_timesteps=200, log_folder=tmp_path)
    final = plain.run.read_info()["final"]
    assert (final["measured_by"], final["optimum"], final["full_optimum"]) == (
        "observation", -10, 100,
    )  # fmt: skip


def test_who_draws_its_actions_is_not_followed():
    spec = spec_of("random", TIGER, STACKED)
    env = make_evaluation_env(spec, 1)
    agent = load_algorithm("random")("RandomPolicy", env)
    assert world_of_memory(spec, agent) is None
