"""Draws the pictures of README and docs: ``python docs/scripts/draw_images.py``.

All pictures are made by the version that is checked out: it renders environments, trains agents and
draws their runs with the code that users run. The picture of a study's page needs Chromium, and the
curves of the headline study need that study; without these, old pictures are kept. With names of
pictures as arguments, only these are drawn.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
IMAGES = DOCS / "images"
sys.path[:0] = [str(ROOT), str(DOCS / "scripts")]
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

WIDEST = 560  # pixels, of an environment
# Figures of the study in docs/library-vs-hand-rolled.md, on seeds that were not used for tuning.
HEADLINE = {
    "Taxi-v4_learning_curves.png": "taxi-curves.png",
    "FrozenLake8x8-v1_intervals.png": "lake8x8-intervals.png",
    "performance_profiles.png": "profiles.png",
}
DOTS: dict[str, Any] = {"markersize": 4.5, "markeredgewidth": 0, "alpha": 0.5}
FALLING, OPTIMISTIC, LEARNT = "falling step size", "optimistic values", "last step learnt"
SMALL_STEPS = "johnnycode8 with step size 0.1, discount 0.99"
# Rows of docs/images/tutorials.png: an environment of studies/tutorials.yml, and, where its runs
# miss the optimum, a change, and the agent and the environment that have it (empty: the same).
TUTORIALS: dict[str, tuple[str, ...]] = {
    "Hugging Face, dry lake": (),
    "Gymnasium, dry lake 11x11": (OPTIMISTIC, OPTIMISTIC, ""),
    "Hugging Face's lake settings on ice": (FALLING, FALLING, ""),
    "Gymnasium's lake settings on ice": (FALLING, FALLING, ""),
    "Juliani, ice": (OPTIMISTIC, OPTIMISTIC, ""),
    "Simonini, ice": (f"{FALLING}\nand {OPTIMISTIC}", "both", ""),
    "deeplizard, ice": (FALLING, FALLING, ""),
    "johnnycode8, ice 8x8": ("step size 0.1\nand discount 0.99", "as taught", SMALL_STEPS),
    "LearnDataSci, Taxi": (),
    "Simonini, Taxi": (),
    "Hugging Face, Taxi": (),
    "Gymnasium, Taxi": (LEARNT, "as taught", f"Gymnasium, Taxi, {LEARNT}"),
    "Gymnasium, Taxi with masks": (LEARNT, "as taught", f"Gymnasium, Taxi with masks, {LEARNT}"),
    "Britz, cliff": (),
}
SLIPPERY = ("slip:0.1", "shelf_reward:-5")


def main() -> None:
    """Draw all pictures, or the named ones."""
    parser = argparse.ArgumentParser(description="Draw the pictures of README and docs.")
    parser.add_argument("names", nargs="*", help=f"of {', '.join(PICTURES)}; all without")
    names = parser.parse_args().names
    unknown = set(names) - set(PICTURES)
    if unknown:
        sys.exit(f"there is no picture {', '.join(sorted(unknown))}, but {', '.join(PICTURES)}")
    for name in names or PICTURES:
        print(name, flush=True)
        PICTURES[name]()


def draw_environments() -> None:
    """Each environment at the start of an episode."""
    import gymnasium as gym
    from PIL import Image

    import rl_yardstick.envs  # noqa: F401  # registers them
    from fill_tables import requested
    from rl_yardstick.pipeline.settings import parse_assignments

    folder = IMAGES / "environments"
    folder.mkdir(exist_ok=True)
    for env_id, *arguments in requested("facts"):
        kwargs = parse_assignments(arguments, env_id)
        env = gym.make(env_id, render_mode="rgb_array", **kwargs)
        env.reset(seed=0)
        picture = Image.fromarray(env.render())  # type: ignore[arg-type]
        picture.thumbnail((WIDEST, WIDEST))
        picture.convert("P", palette=Image.Palette.ADAPTIVE).save(
            folder / f"{env_id}.png", optimize=True
        )
        env.close()


def draw_warehouse() -> None:
    """Pictures of short trainings: a value map on slippery ground, and PPO's learning curve."""
    with tempfile.TemporaryDirectory() as folder:
        slippery = ("--env", "Warehouse-v0", "--algo", "qlearning", "--env-kwargs", *SLIPPERY)
        command("train.py", *slippery, "--seed", "0", "-n", "20000", folder=folder)
        keep(f"{folder}/logs/qlearning/Warehouse-v0_1/value_map.png", "value-map.png")
        chosen = ("--env", "Warehouse-v0", "--algo", "ppo")
        command("train.py", *chosen, "--seed", "0", folder=folder)
        keep(f"{folder}/logs/ppo/Warehouse-v0_1/learning_curve.png", "warehouse-ppo.png")


def draw_report() -> None:
    """The top of the page of a study of one minute, as a screenshot by Chromium."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        print("no Chromium: docs/images/report.png stays as it is")
        return
    agents = ("--algos", "qlearning", "sarsa", "expected_sarsa", "double_qlearning")
    with tempfile.TemporaryDirectory() as folder:
        study = ("--env", "FrozenLake8x8-v1", *agents, "--seeds", "10", "--first-seed", "1000")
        command("compare.py", *study, "--name", "shown", folder=folder)
        page = Path(folder) / "logs/studies/shown/report.html"
        words = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        size = ["--window-size=1280,1000", "--virtual-time-budget=8000"]
        shot = Path(folder) / "report.png"
        subprocess.run(
            [*words, *size, f"--screenshot={shot}", page.as_uri()], check=True, capture_output=True
        )
        keep(shot, "report.png")


# The colours of GitHub's pages, by the name of the picture.
DOTS = {
    "dots.svg": {"page": "#ffffff", "ink": "#1f2328", "muted": "#59636e", "line": "#d1d9e0"}
    | {"soft": "#eff2f5", "blue": "#0969da", "red": "#d1242f"},
    "dots-dark.svg": {"page": "#0d1117", "ink": "#f0f6fc", "muted": "#9198a1", "line": "#3d444d"}
    | {"soft": "#1c222b", "blue": "#58a6ff", "red": "#ff7b72"},
}


def draw_dots() -> None:
    """Each run of the headline study as a dot, from docs/measured/held-out.csv alone."""
    import numpy as np
    import pandas as pd
    from jinja2 import Environment, FileSystemLoader

    from rl_yardstick.experiments.analysis import MARK
    from rl_yardstick.report.series import SCORES, STRETCHED
    from rl_yardstick.report.words import duration

    runs = pd.read_csv(DOCS / "measured" / "held-out.csv")
    runs["place"] = np.interp(runs["score"], SCORES, STRETCHED)
    changed = set(runs["agent"][runs["changed"] == 1])
    panels = []
    for name, here in runs.groupby("environment", sort=False):
        rows = []
        for agent, found in here.groupby("agent", sort=False):
            failed = found["failed"] == 1
            row = {"name": f"{agent} {MARK}" if agent in changed else agent, "n": len(found)}
            places = {"dots": found["place"][~failed], "failed": found["place"][failed]}
            row["dots"] = {kind: list(where) for kind, where in places.items()}
            row["median"] = np.interp(found["score"].median(), SCORES, STRETCHED)
            row["cost"] = duration(float(found["cpu_seconds"].median()))
            rows.append(row)
        panels.append({"name": name, "rows": rows})
    loader = FileSystemLoader(Path(__file__).parent)
    template = Environment(loader=loader, trim_blocks=True, autoescape=True).get_template(
        "dots.svg.jinja"
    )
    shown = {"panels": panels, "n_runs": len(runs), "scores": SCORES, "places": STRETCHED}
    for picture, colours in DOTS.items():
        (IMAGES / picture).write_text(template.render(**shown, **colours), encoding="utf-8")


def copy_headline() -> None:
    """Figures of the headline study, if it is in logs/studies/held-out; it takes an hour."""
    folder = ROOT / "logs" / "studies" / "held-out" / "figures"
    for figure, name in HEADLINE.items():
        if (folder / figure).exists():
            keep(folder / figure, name)
        else:
            print(f"no {folder / figure}: docs/images/{name} stays as it is")


def draw_tutorials() -> None:
    """The runs of studies/tutorials.yml as dots, if the study is in logs/studies/tutorials."""
    import matplotlib as mpl
    import pandas as pd

    from rl_yardstick.report.series import COLOURS

    table = ROOT / "logs" / "studies" / "tutorials" / "summary.csv"
    if not table.exists():
        print(f"no {table}: docs/images/tutorials.png stays as it is")
        return
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    scores = pd.read_csv(table).groupby(["agent", "environment"])["score"]
    figure, axis = plt.subplots(figsize=(9, 7), layout="constrained")
    for place, (row, change) in enumerate(TUTORIALS.items()):
        strips = [("as taught", row), *([(change[1], change[2] or row)] if change else [])]
        for k, strip in enumerate(strips):
            dots = scores.get_group(strip).to_numpy()
            # Equal runs lie above one another.
            spread = [0.3 * ((7 * n % len(dots)) / len(dots) - 0.5) for n in range(len(dots))]
            middle = place + (0.4 * k - 0.2 if change else 0)
            axis.plot(dots, [middle + y for y in spread], "o", color=COLOURS[k], **DOTS)
        if change:
            axis.text(1.03, place + 0.2, change[0], va="center", color=COLOURS[1], fontsize=9)
    for colour, label in zip(COLOURS, ("as taught", "with the change at the right"), strict=False):
        axis.plot([], [], "o", color=colour, label=label, **DOTS)
    axis.legend(loc="lower left", bbox_to_anchor=(0.05, 0.27), frameon=False)
    axis.axvline(1, color="black", lw=1)
    axis.text(1, -0.65, "optimum", ha="center", va="bottom", fontsize=9)
    axis.set_yticks(range(len(TUTORIALS)), [*TUTORIALS])
    axis.set(ylim=(len(TUTORIALS) - 0.5, -0.6), xlim=(-0.6, 1.6), xticks=[-0.5, 0, 0.5, 1])
    axis.set_xlabel("score of a run: 0 the best random or constant policy, 1 the optimum")
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(IMAGES / "tutorials.png", dpi=100)
    keep(IMAGES / "tutorials.png", "tutorials.png")


def command(script: str, *words: str, folder: str) -> None:
    """Run one of the project's commands in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, str(ROOT / script), *words]
    subprocess.run(line, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)


def keep(source: str | Path, name: str) -> None:
    """Save a picture among the docs' images, in a palette of 256 colours."""
    from PIL import Image

    with Image.open(source) as picture:
        few = picture.convert("RGB").convert("P", palette=Image.Palette.ADAPTIVE)
        few.save(IMAGES / name, optimize=True)


PICTURES: dict[str, Callable[[], None]] = {
    "environments": draw_environments,
    "warehouse": draw_warehouse,
    "report": draw_report,
    "dots": draw_dots,
    "headline": copy_headline,
    "tutorials": draw_tutorials,
}

if __name__ == "__main__":
    main()
