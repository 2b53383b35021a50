"""Logs of runs that were done elsewhere, in the forms that other programs write them."""

import json
import re
import shlex
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from stable_baselines3 import A2C
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor

import rl_yardstick as ys
from rl_yardstick.experiments.analysis import analyse
from rl_yardstick.experiments.logs import find_logs
from rl_yardstick.experiments.others import PATTERNS, labels_in, results_of
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.report.series import learning_curves
from tests.pipeline.short_runs import Steady, trained

ROOT = Path(__file__).parents[2]

# The final figure of each run; sums and means of quarters are exact.
FIGURES = {
    (agent, seed): mean + (seed % 3) / 4
    for agent, mean in (("good", 8.5), ("poor", 2.25))
    for seed in range(1, 7)
}


def table(figures=FIGURES, **changes):
    rows = [{"agent": a, "seed": s, "score": value} for (a, s), value in figures.items()]
    return pd.DataFrame(rows).assign(**changes)


def judge(what, **settings):
    with TemporaryDirectory() as folder:
        return ys.judge(what, folder=folder, no_report=True, **settings)


def told(found):
    """What was printed, without its line ends."""
    return " ".join(" ".join(found.lines).split())


def episodes(value):
    """Of which the last hundred have this mean."""
    return [0.0] * 20 + [value - 1, value + 1] * 50


def monitor(path, returns):
    env = Monitor(Steady(returns), str(path))
    for _ in returns:
        env.reset()
        env.step(0)
    env.close()


def monitors(folder, value):
    """Of two environments, the second with fewer episodes: they count alike."""
    monitor(folder / "0", [value + 0.5] * 130)
    monitor(folder / "1", [value - 0.5] * 30)


def named_monitor(folder, value):
    """As ``Monitor(env, "folder/monitor")`` names it."""
    monitor(folder / "monitor", episodes(value))
    assert [path.name for path in folder.iterdir()] == ["monitor.monitor.csv"]


def old_monitor(folder, value):
    rows = "".join(f"{r},1,{0.5 * k}\n" for k, r in enumerate(episodes(value)))
    (folder / "monitor.csv").write_text(rows)


def damaged_monitor(folder, value):
    monitor(folder / "0", episodes(value))
    path = folder / "0.monitor.csv"
    first, second, *rows = path.read_text().splitlines()
    torn = [*rows[:9], "3.0,1,2.5514.0,1,2.75", *rows[9:], "nan,1,3.0", "8.0,1"]
    path.write_text("\n".join([first, second, *torn]))


def evaluations(folder, value):
    env = Monitor(Steady([value - 1, value + 1]))
    log = EvalCallback(env, eval_freq=8, n_eval_episodes=2, log_path=str(folder), verbose=0)
    learner().learn(16, callback=log)


@cache
def learner():
    return A2C("MlpPolicy", Steady([0.0]), n_steps=4, device="cpu", seed=0)


def progress(folder, value, kind="csv"):
    log = configure(str(folder), [kind])
    for step, mean in ((100, 0.25), (200, value)):
        log.record("rollout/ep_rew_mean", mean)
        log.record("time/total_timesteps", step)
        log.record("train/value_loss", 99.0)
        log.dump(step)
    log.close()


def events(folder, value):
    progress(folder, value, "tensorboard")


def sampled(folder, value):
    """Of thousands of episodes: of 21 points the last two count."""
    rows = [(500 * k, value + (k - 19.5 if k > 18 else -k)) for k in range(21)]
    made = pd.DataFrame(rows, columns=["global_step", "charts/episodic_return"])
    made.to_csv(folder / "progress.csv", index=False)


@pytest.mark.parametrize(
    "write",
    [monitors, named_monitor, old_monitor, damaged_monitor, evaluations, progress, events, sampled],
)
def test_run_folders_are_judged_as_their_numbers_are(tmp_path, write):
    for (agent, seed), value in FIGURES.items():
        folder = tmp_path / agent / f"Lake-v7_{seed}"
        folder.mkdir(parents=True)
        write(folder, value)
    results = results_of(*find_logs([tmp_path], {}), tmp_path)
    shown = [*FIGURES.values()] if write not in (evaluations, sampled) else [None] * len(FIGURES)
    assert [*results.summary["last_episodes"].replace(np.nan, None)] == shown
    curves = learning_curves(results, analyse(results).environments[0])
    assert {one.budget for one in curves.values()} == {"step"}
    words = {evaluations: "last evaluation", sampled: "mean return in the last tenth of the logged"}
    check(judge(tmp_path), words.get(write, "last 100 training"))


def check(found, words):
    expected = judge(table(env="Lake-v7"))
    pd.testing.assert_frame_equal(found.table, expected.table)
    pd.testing.assert_frame_equal(found.verdicts, expected.verdicts)
    assert expected.verdicts["verdict"].tolist() == ["better"]
    finals = found.runs.set_index(["agent", "seed"])["final"]
    assert finals.to_dict() == {(agent, seed - 1): mean for (agent, seed), mean in FIGURES.items()}
    assert words in told(found)


def curves(name, n=3):
    """A row for each step of each run; the last one has the figure."""
    return pd.DataFrame(
        {"algo": agent, "run": seed, "global_step": 100 * k, name: k if k < n else value}
        for (agent, seed), value in FIGURES.items()
        for k in range(1, n + 1)
    )


def episodes_table():
    return pd.concat(
        pd.DataFrame({"method": a, "trial": s, "episode": range(120), "Return": episodes(value)})
        for (a, s), value in FIGURES.items()
    )


def lengths_table():
    """The length of each episode is no axis."""
    rows = episodes_table().rename(columns={"Return": "reward"})
    return rows.assign(steps=200 - rows["reward"] - rows["episode"] % 3)


def of_rlberry():
    long = curves("value").rename(columns={"algo": "name", "run": "n_simu"})
    times = long.assign(tag="dw_time_elapsed", value=7.0)
    return pd.concat([times, long.assign(tag="eval_rewards")]).assign(dw_time_elapsed=0.5)


def of_wandb():
    names = {key: f"Lake-v7__{key[0]}__{key[1]}__1700000000" for key in FIGURES}
    found = {"Step": [100, 200, 300]}
    for key, value in FIGURES.items():
        for end in ("", "__MIN", "__MAX"):
            found[f"{names[key]} - charts/ep_rew_mean{end}"] = [1.0, np.nan, value]
    return pd.DataFrame(found)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (table().rename(columns={"agent": "Algorithm", "score": "Mean Reward"}), "Mean Reward"),
        (curves("return"), "last return"),
        (curves("eval/mean_reward"), "last evaluation"),
        (curves("rollout/ep_rew_mean"), "last 100 training"),
        (episodes_table(), "last 100 training"),
        (lengths_table(), "last 100 training"),
        (table().rename(columns={"score": "charts/episodic_return"}), "charts/episodic_return"),
        (of_rlberry(), "last evaluation"),
        (of_wandb(), "last 100 training"),
    ],
)
def test_tables_are_judged_as_their_numbers_are(tmp_path, made, words):
    path = tmp_path / "exported.csv"
    made.to_csv(path, index=False, sep=";" if "eval" in words else ",")
    check(judge(path, env="Lake-v7"), words)


def test_a_table_of_one_run_has_the_labels_of_its_path(tmp_path):
    for (agent, seed), rows in curves("return").groupby(["algo", "run"]):
        rows[["global_step", "return"]].to_csv(tmp_path / f"{agent}_{seed}.csv", index=False)
    check(judge(tmp_path, env="Lake-v7"), "last return")


def test_columns_are_those_that_are_named(tmp_path):
    made = table().rename(columns={"agent": "who", "score": "points"})
    assert "run: points" in told(judge(made, columns={"agent": "who", "score": "points"}))
    with pytest.raises(UserError, match=r"no known column of returns \(who, seed, points\)"):
        judge(made)
    with pytest.raises(UserError, match="no column 'whom': did you mean 'who'"):
        judge(made, columns={"agent": "whom"})
    for wrong in (made[:0], made.astype({"points": str}).replace(r"\.", ",", regex=True)):
        with pytest.raises(UserError, match="column points holds no numbers"):
            judge(wrong, columns={"agent": "who", "score": "points"})
    with pytest.raises(UserError, match="judge has no setting 'margins'"):
        judge(made, margins=1)


def test_scores_are_on_the_scale_where_the_environment_is_known():
    """FrozenLake without slipping: the optimum is 1, and constant actions never arrive."""
    figures = {key: value / 10 for key, value in FIGURES.items()}
    found = judge(table(figures, env="FrozenLake-v1"), env_kwargs={"is_slippery": False})
    assert set(found.runs["optimum"]) == {1.0}
    baseline = found.runs["baseline"][0]
    means = [np.mean([figures[a, s] for s in range(1, 7)]) for a in found.table["name"]]
    scores = [(mean - baseline) / (1 - baseline) for mean in means]
    assert found.table["mean"].tolist() == pytest.approx(scores)
    assert judge(table(figures, env="OtherLake-v1")).runs["optimum"].isna().all()
    figures = {key: 0.809 if "poor" in key else 1.0 for key in FIGURES}
    slippery = judge(table(figures, env="FrozenLake-v1"))
    assert "returns of good above the optimum 0.7442" in told(slippery)
    assert slippery.runs["optimum"].isna().all()
    assert slippery.verdicts["verdict"].tolist() == ["better"]


@pytest.mark.parametrize(
    ("path", "labels"),
    [
        ("logs/ppo/CartPole-v1_3", ("ppo", "CartPole-v1", "3")),
        ("x/dqn/ALE-Pong-v5/seed_12", ("dqn", "ALE-Pong-v5", "seed_12")),
        ("runs/CartPole-v1__dqn__4__1700000000", ("dqn", "CartPole-v1", "4")),
        ("res/LunarLander-v3/sac_s2", ("sac", "LunarLander-v3", "s2")),
        ("res/my_agent_CartPole-v1_0", ("my_agent", "CartPole-v1", "0")),
        ("tb/PPO_1", ("PPO", None, "1")),
        ("my runs/base line/run 1", ("base line", None, "run 1")),
        ("q/2026-01-01_12-30-00", ("q", None, "2026-01-01_12-30-00")),
        ("out/mine", ("mine", None, None)),
    ],
)
def test_the_first_usual_pattern_that_fits(path, labels):
    found = next(found for one in PATTERNS if (found := labels_in(path, one)))
    assert (found["agent"], found.get("env"), found.get("seed")) == labels


def test_what_is_assumed_is_told(tmp_path):
    unseeded = curves("return").drop(columns="run")
    found = judge(unseeded)
    assert found.table["n"].tolist() == [6, 6]
    assert "no column of seeds: each part, to where 'global_step' falls," in told(found)
    assert "each row counts as a seed" in told(judge(table().drop(columns="seed")))
    assert judge(table()[["score"]]).table["n"].tolist() == [len(FIGURES)]
    assert "one agent only, good" in told(judge(table().query("agent == 'good'")))
    assert "no log names its environment: --env gives it" in told(found)
    figures = FIGURES | {("good", 3): float("nan")}
    left_out = told(judge(table(figures)))
    assert re.search(r"left out: 1 run without such a figure: \S*/table, good, 3 ", left_out)
    twice = pd.concat([table(lr=0.1), table(lr=0.5)]).set_index(["agent", "seed"])
    columns = "has up to 2 rows for each agent, seed: averaged (other columns: lr)"
    assert columns in told(judge(twice))
    lengths = lengths_table().drop(columns="episode")
    columns = "up to 120 rows for each agent, seed: averaged (other columns: steps)"
    assert columns in told(judge(lengths))
    ends = [(a, s, n) for a, most in (("a", 20), ("b", 30)) for s in (0, 1) for n in (10, most)]
    rows = [(agent, "X", seed, n, seed) for agent, seed, n in ends]
    made = pd.DataFrame(rows, columns=["agent", "env", "seed", "step", "return"])
    assert "X: the shortest run ends at 20 (a), the longest at 30 (b)" in told(judge(made))


def test_files_that_are_no_logs_are_counted(tmp_path):
    (tmp_path / "notes.csv").write_text("day,weather\n1,sun\n")
    (tmp_path / "arrays.npz").write_text("no archive")
    (tmp_path / "0.monitor.csv").write_text("once upon a time\n")
    table().to_csv(tmp_path / "scores.csv")
    _, (note,) = find_logs([tmp_path], {})
    assert note.startswith("skipped 3 files: ")
    assert "needs rows of r,l,t" in note
    for name in ("notes.csv", "arrays.npz", "missing.csv"):
        with pytest.raises(UserError, match=name):
            judge(tmp_path / name)


def test_rows_that_are_no_episodes_are_named(tmp_path):
    damaged_monitor(tmp_path, 3.0)
    (log,), (note,) = find_logs([tmp_path], {})
    assert note.endswith("skipped 3 of 123 rows, no episodes: lines 12, 124, 125")
    assert log.figures == {"training": 3.0}


def test_runs_without_the_figure_of_most_runs_are_counted(tmp_path):
    """Of six runs one has no evaluations, another only NaN; a third has no episode at all."""
    for seed in range(1, 7):
        folder = tmp_path / "ppo" / str(seed)
        folder.mkdir(parents=True)
        old_monitor(folder, 3.0)
        results = np.full((2, 5), np.nan if seed == 2 else float(seed))
        if seed > 1:
            np.savez(folder / "evaluations.npz", timesteps=[50, 100], results=results)
    (tmp_path / "ppo" / "7").mkdir()
    (tmp_path / "ppo" / "7" / "monitor.csv").write_text('#{"t_start": 1, "env_id": "None"}\n')
    found = judge(tmp_path)
    assert found.runs["final"].tolist() == [3.0, 4.0, 5.0, 6.0]
    assert set(found.runs["environment"]) == {"environment"}
    assert "mean return in the last evaluation left out: 3 runs without such a " in told(found)


def test_labels_belong_to_one_run(tmp_path):
    for place in ("a/ppo_1", "b/ppo_1"):
        (tmp_path / place).mkdir(parents=True)
        old_monitor(tmp_path / place, 3.0)
    with pytest.raises(UserError, match="two runs are ppo, environment, 1"):
        judge(tmp_path)
    found = judge(tmp_path, pattern="{env}/{agent}_{seed}")
    assert found.table["environment"].tolist() == ["a", "b"]
    with pytest.raises(UserError, match="name agent, env and seed"):
        judge(tmp_path, pattern="{algo}_{seed}")


def test_files_of_strangers_import_no_module(tmp_path, monkeypatch):
    """Neither an environment's id nor its arguments run code; damaged settings are no logs."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "taken.py").write_text("raise SystemExit('imported')")
    gym.register("Taken-v0", entry_point="taken:Env")
    try:
        found = judge(table(env="Taken-v0"))
    finally:
        gym.registry.pop("Taken-v0")
    assert found.runs["env_id"].isna().all()
    folder = tmp_path / "ppo" / "Lake-v7_1"
    folder.mkdir(parents=True)
    old_monitor(folder, 3.0)
    wrong, half = {"mean_return": 8.0, "optimum": "x"}, {"mean_return": 8.0, "optimum": 9.0}
    for final, mean in (({"mean_return": "8"}, 3.0), (wrong, 8.0), (half, 8.0), ([1], 3.0)):
        (folder / "run.json").write_text(json.dumps({"final": final}))
        assert judge(tmp_path).table["mean"].tolist() == [mean]


PAGE = (ROOT / "docs" / "other-runs.md").read_text()


@pytest.mark.usefixtures("in_this_process")
def test_the_commands_of_the_page(typed, own_folder):
    """On runs of this project, whose final figures are those that they have recorded."""
    runs = {name: trained(name, n_timesteps=300) for name in ("qlearning", "sarsa")}
    finals = {name: outcome.final.mean_return for name, (_, outcome) in runs.items()}
    table().to_csv("scores.csv")
    for agent in ("ppo", "dqn"):
        (own_folder / agent / "1").mkdir(parents=True)
        monitor(own_folder / agent / "1" / "0", episodes(3.0))

    for line in re.findall(r"^yardstick (.*?)(?: +#.*)?$", PAGE, re.MULTILINE):
        page = [] if "scores" in line else ["--no-report"]
        typed.done("yardstick", *shlex.split(line), "-f", "studies", *page)
    rows = pd.read_csv("studies/logs/summary.csv").set_index("agent")
    assert rows["final"].to_dict() == finals
    page = Path("studies/scores/report.html").read_text()
    assert all(f'id="{part}"' in page for part in ("verdict", "ranking", "comparison"))
    assert 'id="films"' not in page
    assert "--seeds cannot be given with logs" in typed("compare.py", "logs", "--seeds", 3)[2]
    assert "--pattern and --columns belong to logs" in typed("compare.py", "--pattern", "x")[2]
    assert "nowhere is no folder or file" in typed("compare.py", "logs", "nowhere")[2]
