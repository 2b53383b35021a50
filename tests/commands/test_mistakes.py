"""A mistake ends each command in one line, with code 2, and leaves nothing."""

import pytest

FILES = {
    "map.txt": "S..\n.x.\n..G\n",
    "broken.yml": "FrozenLake-v1:\n  gamma: [1\n  policy: x\n",
    "plain.yml": "CliffWalking-v1: {n_timesteps: 10, policy: ActionTablePolicy}\n",
    "bad.yml": "agents: {qlearning: {gamma: 2}}\nenvironments: [FrozenLake-v1]\nn_timesteps: 9\n",
    "grows.yml": "agents: [ucb, random]\nenvironments: [BernoulliBandit-v0]\nn_timesteps: 9\n",
    "a.yml": "default:\n  n_timesteps: 9\n",
    "space.yml": "default:\n  gamma: {low: 0.5, high: 1}\n  learning_rate: {low: 0.1, high: 1}\n",
    "odd.yml": "default: {train_env_kwargs.maxx_episode_steps: [5, 50]}\n",
    "page.html/index": "a folder is in the way",
    "taken/qlearning": "a file is in the way",
}
LAKE = "--algo qlearning --env FrozenLake-v1"
QUICK = f"train.py {LAKE} --seed 0 -n 500"
PAIR = "compare.py --env FrozenLake-v1 --algos qlearning sarsa --n-episodes 60 --no-report"
TUNE = f"tune.py {LAKE}"
RUN = "qlearning on FrozenLake-v1, seed 0, 500 steps"
STUDY = "qlearning, sarsa on FrozenLake-v1"
SEARCH = "qlearning on FrozenLake-v1: a search for settings"
PLAIN = "optimal on CliffWalking-v1, seed 0, 10 steps"
CARTS = "ppo on CartPole-v1, seed 0, 500 steps"

MISTAKES = [
    ("train.py --env Warehose-v0", "unknown environment 'Warehose-v0': did you mean"),
    ("train.py --algo qlerning", "unknown agent 'qlerning': did you mean 'qlearning'?"),
    ("train.py --evn X", "unknown argument --evn"),
    (f"{QUICK} -n many", "must be a whole number of at least 1, or -1"),
    (f"{QUICK} -params learning_rate", "learning_rate"),
    (f"{QUICK} -params n_episodes:5", "not both"),
    (f"{QUICK} --conf-file nowhere.yml", "nowhere.yml"),
    (f"{QUICK} --conf-file broken.yml", "broken.yml:3:9: "),
    (f"{QUICK} --env-kwargs slipery:True", "slipery"),
    (f"{QUICK} --env Warehouse-v0 --env-kwargs desc:map.txt", "letter 'x' at row 2, column 2"),
    (f"{QUICK} -i nowhere.zip", "no such model file: nowhere.zip"),
    (f"{QUICK} --gym-packages no_such_module", "cannot import no_such_module"),
    (f"{QUICK} --watch-learning page.html", "page.html is a folder"),
    ("train.py --algo qlearning --env MountainCarContinuous-v0",
     "fitting agents: ppo, a2c, sac, td3, ddpg, tqc, crossq, trpo, ars, ppo_lstm, random"),
    ("train.py --algo sac --engine compiled -n 9",
     "--engine compiled: sac has one engine, which auto means"),
    ("train.py --resume logs --engine auto",
     "--engine cannot be given with --resume: the run has its own"),
    ("train.py -optimize --n-trials 100", "by the command tune: see tune --help"),

    ("enjoy.py --algo dqn --env CartPole-v1",
     "train one with: python train.py --algo dqn --env CartPole-v1"),
    ("enjoy.py --record film.avi", ".gif or .mp4"),
    ("enjoy.py -P", "-P: there is no bar; each episode is printed as it ends"),
    ("enjoy.py --n-envs 0", "--n-envs: must be a whole number of at least 1, not '0'"),
    ("enjoy.py map.txt --trust", "unknown argument --trust: it is not needed"),

    ("compare.py", "what to compare? give --env and --algos, or a study file"),
    ("compare.py --env Taxi-v4", "give --env and --algos"),
    ("compare.py bad.yml --env Taxi-v4", "not both"),
    ("compare.py --env Taxy-v4 --algos dqn", "did you mean 'Taxi-v4'"),
    ("compare.py --env Taxi-v4 --algos dqnn", "did you mean 'dqn'?"),
    ("compare.py --env Taxi-v4 --algos dqn dqn", "--algos names one of them"),
    ("compare.py --env MountainCarContinuous-v0 --algos sarsa", "does not fit"),
    ("compare.py nowhere.yml", "nowhere.yml: cannot be read"),
    (f"{PAIR} -n 5", "not both"),
    (f"{PAIR} --seds 3", "did you mean '--seeds'?"),
    (f"{PAIR} --metric finl", "did you mean 'final'?"),
    (f"{PAIR} --gym-packages no_such", "cannot import no_such"),
    (f"{PAIR} --env-kwargs slipery:True", "slipery"),
    (f"{PAIR} --watch-learning", "leave out --no-report"),
    (f"{PAIR} --conf-file a.yml",
     "--conf-file a.yml: whose hyperparameters? a file has those of"),
    (f"{PAIR} --conf-file sarsa:a.yml sarsa:a.yml", "--conf-file names two files for sarsa"),
    (f"{PAIR} --conf-file sarsa:no.yml", "--conf-file: there is no file no.yml"),
    (f"{PAIR} --conf-file dqn:a.yml", "(qlearning, sarsa): qlearning:dqn:a.yml"),
    ("compare.py grows.yml --until-decided --quick",
     "--until-decided and --quick do not go together"),
    ("compare.py grows.yml --until-decided --replace",
     "--until-decided and --replace do not go together"),
    ("compare.py grows.yml --max-seeds 9", "--max-seeds belongs to --until-decided"),

    ("tune.py --env FrozenLake-v1 --algo qlerning", "did you mean 'qlearning'?"),
    (f"{TUNE} --search-space none.yml", "--search-space: there is no file none.yml"),
    (f"{TUNE} --first-seed 998", "seed 1000 is one of the search and of the re-test"),
    (f"{TUNE} --storage redis://u:secret@h", "--storage: 'redis://u:***@h' is no"),
    (f"{TUNE} -n 9 --n-episodes 9", "give -n or --n-episodes, not both"),
    (f"{TUNE} --n-evaluations 3", "--eval-freq"),
]  # fmt: skip

# What only the libraries can tell comes after the line that is printed before they are loaded.
LATE = [
    (f"{QUICK} -params learning_rat:0.1", RUN, "did you mean 'learning_rate'?"),
    (f"{QUICK} -params gamma:high", RUN, "gamma"),
    (f"{QUICK} -params gamma:1.5", RUN, "gamma"),
    (f"{QUICK} -params exploration:greedy", RUN, "exploration"),
    (f"{QUICK} -tb /dev/null/logs", RUN, "Not a directory: /dev/null/logs"),
    (f"{QUICK} -params engine:compiled --vec-env subproc", RUN, "is not DummyVecEnv"),
    (f"{QUICK} --algo ppo --env CartPole-v1 -params n_steps:1 n_envs:1", CARTS, "n_steps"),
    (f"{PAIR} -params gama:0.9", STUDY, "did you mean 'gamma'?"),
    (f"{QUICK} -f taken", RUN, "cannot make a run folder in taken/qlearning"),
    (f"{TUNE} --search-space odd.yml", SEARCH, "'maxx_episode_steps': did you mean"),
    (
        f"{TUNE} --search-space space.yml --storage .",
        SEARCH,
        "--storage journal:FILE: . is no file",
    ),
    (f"{TUNE} --search-space space.yml --sampler grid --trials 3", SEARCH, "give more trials"),
    (f"{TUNE} -params gama:0.9", SEARCH, "did you mean 'gamma'?"),
    (
        "train.py --algo optimal --env CliffWalking-v1 --seed 0 --conf-file plain.yml",
        PLAIN,
        "needs a time limit",
    ),
    (
        "compare.py grows.yml --until-decided --max-seeds 5",
        "grows",
        "--max-seeds is 5, the study begins with 10 seeds",
    ),
    ("compare.py bad.yml", "bad", "bad.yml:1: qlearning: gamma"),
]

CASES = [*((line, "", complaint) for line, complaint in MISTAKES), *LATE]


@pytest.mark.parametrize(
    ("line", "head", "complaint"),
    CASES,
    ids=[line for line, *_ in CASES],
)
def test_one_line_and_nothing_left(type_in_own_folder, own_folder, line, head, complaint):
    for name, text in FILES.items():
        (own_folder / name).parent.mkdir(exist_ok=True)
        (own_folder / name).write_text(text)
    before = sorted(own_folder.rglob("*"))
    code, out, err = type_in_own_folder(*line.split())
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith(f"{line.split()[0]}: error: ")
    assert complaint in err
    assert "secret" not in err
    assert out.partition("\n")[0] == head
    assert sorted(own_folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("line", "missing", "extra"),
    [(f"{QUICK} -tb curves", "-tb needs", "tensorboard"), (TUNE, "tuning needs", "tune")],
)
def test_what_is_not_installed_is_named_beforehand(
    type_in_own_folder, own_folder, monkeypatch, line, missing, extra
):
    # What a machine has without the packages that are optional.
    monkeypatch.setattr("importlib.util.find_spec", lambda *_: None)
    code, out, err = type_in_own_folder(*line.split())
    assert (code, out) == (2, "")
    told = f"{missing}: pip install 'rl-yardstick[{extra}]'\n"
    assert err == f"{line.split()[0]}: error: {told}"
    assert not list(own_folder.iterdir())
