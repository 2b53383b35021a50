"""What the page of a large study costs: seconds to judge, draw and write it, its size, its loading.

    python benchmarks/page_scale.py            # 10 agents, 10 environments, 30 seeds
    python benchmarks/page_scale.py 5 2 10     # others

Nothing is trained: learning curves rise to an end that each agent has on each environment, with
noise, and runs that fail. Seconds are processor time of this process, and in the end of a headless
Chromium's for the page, where there is one with its driver. Maps and films are not in it: on a page
they take up to 2 MB more.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pandas as pd

from experiments.analysis import analyse
from experiments.results import CURVE_COLUMNS, RUN_COLUMNS, StudyResults
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from report.figures import write_figures
from report.page import write_report
from report.page.frame import Report
from report.series import study_series

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


def timed(name: str, work: Callable[[], Any]) -> Any:
    """What the work returns; its seconds are printed."""
    started = time.process_time()
    result = work()
    print(f"{name:<28} {time.process_time() - started:7.2f} s")
    return result


def loading(page: Path) -> tuple[float, float] | None:
    """Seconds of processor time that a page takes: until it stands still, and with all drawn.

    Those of the browser's process for the page; None without Chromium and its driver.
    """
    from selenium import webdriver

    browser, driver_path = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver_path is None:
        return None
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
        ready = _seconds(driver)
        driver.execute_script("report.drawAll()")
        return ready - before, _seconds(driver) - before
    finally:
        driver.quit()


def _seconds(driver: Any) -> float:
    metrics = driver.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
    return float(next(one["value"] for one in metrics if one["name"] == "ProcessTime"))


def main() -> None:
    """Print the table."""
    n_agents, n_environments, n_seeds = map(int, sys.argv[1:4] or ["10", "10", "30"])
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        page = root / "report.html"
        results = timed("making it up", lambda: made_up(n_agents, n_environments, n_seeds, root))
        analysis = timed("judging", lambda: analyse(results))
        series = timed("working out the curves", lambda: study_series(analysis))
        timed("drawing the figures", lambda: write_figures(series, None))
        timed("writing the page", lambda: write_report(Report(series, "python compare.py"), page))
        print(f"{'size of the page':<28} {page.stat().st_size / 1e6:7.2f} MB")
        seconds = loading(page)
        if seconds is not None:
            print(f"{'ready in Chromium':<28} {seconds[0]:7.2f} s")
            print(f"{'all its figures drawn':<28} {seconds[1]:7.2f} s")


if __name__ == "__main__":
    main()
