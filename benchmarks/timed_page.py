"""What the page of a large study takes: 10 agents, 10 environments, 30 seeds; seconds.

Nothing is trained: learning curves rise to an end that each agent has on each environment, with
noise, and runs that fail. Seconds are of the processor, of this process and of a headless
Chromium's for the page. Maps and films are not in it.
"""

from __future__ import annotations

import shutil
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.analysis import analyse
from experiments.results import CURVE_COLUMNS, RUN_COLUMNS, StudyResults
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from report.figures import write_figures
from report.page import write_report
from report.page.frame import Report
from report.series import study_series
from timing import Benchmark, Contender, Rows, seconds

N_STEPS = 100_000
N_EVALUATIONS = 20
N_BLOCKS = 100
OPTIMUM, BASELINE, WORST = 1.0, 0.0, -20.0
SETTLING = 3  # seconds


def made_up(n_agents: int, n_environments: int, n_seeds: int, root: Path) -> StudyResults:
    """The results of a study that nobody has run."""
    study = StudySpec(
        "scale",
        "A study of many runs",
        tuple(AgentSpec(f"agent {i}", "qlearning", tuned=False) for i in range(n_agents)),
        tuple(EnvironmentSpec(f"World{i}-v0", "FrozenLake-v1") for i in range(n_environments)),
        n_seeds=n_seeds,
    )
    rng = np.random.default_rng(0)
    rows: list[dict[str, Any]] = []
    curves: list[pd.DataFrame] = []
    for environment in study.environments:
        for agent in study.agents:
            talent, speed = rng.uniform(0.4, 1.0), rng.uniform(2, 12)
            for seed in study.seeds:
                end = talent if rng.random() < 0.95 else 0.1
                both = [_curve(rng, end, speed, kind) for kind in ("evaluation", "training")]
                for table in both:
                    table["agent"], table["environment"] = agent.label, environment.label
                    table["seed"] = seed
                    curves.append(table[list(CURVE_COLUMNS)])
                rows.append(_row(agent.label, environment.label, seed, both[0]))
    summary = pd.DataFrame(rows, columns=list(RUN_COLUMNS))
    return StudyResults(study, root, summary, pd.concat(curves, ignore_index=True), ())


def _curve(rng: np.random.Generator, end: float, speed: float, kind: str) -> pd.DataFrame:
    """A run's returns: bad at first, and in the end about what the agent is able to."""
    n = N_EVALUATIONS if kind == "evaluation" else N_BLOCKS
    steps = np.linspace(N_STEPS / n, N_STEPS, n)
    if kind == "training":
        steps = steps - rng.uniform(0, N_STEPS / n, n)
    learnt = 1 - np.exp(-speed * steps / N_STEPS)
    noise = rng.normal(0, 0.05, n)
    value = WORST + (end - WORST) * learnt**0.2 + noise
    seconds = steps / rng.uniform(2e4, 3e4)
    return pd.DataFrame(
        {
            "kind": kind,
            "step": steps,
            "episode": np.floor(steps / rng.uniform(8, 12)),
            "seconds": seconds,
            "value": value,
        }
    )


def _row(agent: str, environment: str, seed: int, evaluations: pd.DataFrame) -> dict[str, Any]:
    final = float(evaluations["value"].iloc[-1])
    reached = evaluations["step"][evaluations["value"] >= 0.6]
    steps = float(reached.iloc[0]) if len(reached) else np.inf
    return {
        "agent": agent,
        "algo": "qlearning",
        "environment": environment,
        "env_id": "FrozenLake-v1",
        "seed": seed,
        "final": final,
        "success_rate": float(np.clip(final, 0, 1)),
        "exact": True,
        "optimum": OPTIMUM,
        "baseline": BASELINE,
        "gap": OPTIMUM - final,
        "score": (final - BASELINE) / (OPTIMUM - BASELINE),
        "best": float(evaluations["value"].max()),
        "area": float(evaluations["value"].mean()),
        "training": final - 0.1,
        "last_episodes": final - 0.05,
        "threshold": 0.6,
        "steps_to_threshold": steps,
        "steps_to_stay": steps,
        "episodes_to_threshold": steps / 10,
        "n_timesteps": N_STEPS,
        "seconds": 4.0,
    }


def loading(page: Path, script: str = "") -> float:
    """What the browser's process for a page takes, until it stands still and has run a script."""
    from selenium import webdriver

    browser, driver_path = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver_path is None:
        raise SystemExit("this needs chromium and chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for flag in ("--headless", "--no-sandbox", "--disable-gpu", "--window-size=1280,900"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver_path))
    try:
        driver.execute_cdp_cmd("Performance.enable", {"timeDomain": "threadTicks"})
        before = _seconds(driver)
        driver.get(page.as_uri())
        time.sleep(SETTLING)
        driver.execute_script(script)
        return _seconds(driver) - before
    finally:
        driver.quit()


def _seconds(driver: Any) -> float:
    metrics = driver.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
    return float(next(one["value"] for one in metrics if one["name"] == "ProcessTime"))


def rows(folder: Path) -> Rows:
    """From the results of runs to the page, and the page in a browser."""
    results, page = made_up(10, 10, 30, folder), folder / "report.html"
    analysis = analyse(results)
    series = study_series(analysis)
    report = Report(series, "python compare.py")
    write_report(report, page)
    steps: dict[str, Contender] = {
        "judging": seconds(partial(analyse, results)),
        "curves": seconds(partial(study_series, analysis)),
        "figures": seconds(partial(write_figures, series, None)),
        "writing the page": seconds(partial(write_report, report, page)),
        "ready in Chromium": partial(loading, page),
        "all its figures drawn": partial(loading, page, "report.drawAll()"),
    }
    size = f"{page.stat().st_size / 1e6:.1f} MB"
    return {f"{name} ({size})": {"seconds": step} for name, step in steps.items()}


BENCHMARK = Benchmark("seconds", rounds=1, rows=rows, is_speed=False)
