"""``enjoy.py``: its flags, the model that they select, and how it is shown."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from secrets import randbelow
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import Flag, Flags, OneLineParser, flag, shared, switch, whole_number
from rl_yardstick.commands.terminal import TextConsole, figures, result_lines, say
from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from rich.console import Console

    from rl_yardstick.pipeline.models import Model, Wanted
    from rl_yardstick.pipeline.playing import RenderMode
    from rl_yardstick.pipeline.spec import TrainSpec

FRAMES_PER_SECOND = 4  # of --render ansi on a terminal

EPILOG = """\
examples:
  python enjoy.py --env Warehouse-v0 --algo ppo
  python enjoy.py --env Warehouse-v0 --algo sarsa --record route.gif --n-episodes 1
  python enjoy.py rl-trained-agents/ppo/CartPole-v1_1
"""

EXP_ID = whole_number(0, besides={-1: "the run without a number"})
RENDERED = ("human", "ansi", "none")
# Flags that select an agent.
MODEL_FLAGS: Sequence[Flag] = (
    flag("model", "a model zip or a run folder (default: a run is looked for)", nargs="?"),
    flag("--algo", "agent (default: ppo, or as in the zip's run folder)"),
    flag("--env", "environment id (default: CartPole-v1, or as in the folder)"),
    flag("-f --folder", "folder of all runs (default: logs)", default="logs"),
    flag("--exp-id", "number of the run (0: the newest; -1: FOLDER/ALGO/ENV.zip)", EXP_ID, 0),
    switch("--load-best", "the model with the best evaluation in training"),
    flag("--load-checkpoint", "the checkpoint after N steps", whole_number(0)),
    switch("--load-last-checkpoint", "the last checkpoint"),
    *shared("--vec-normalize", "--device", "--num-threads", "--env-kwargs", "--gym-packages"),
)
FLAGS: Flags = {
    "": MODEL_FLAGS,
    "playing": (
        flag("-n --n-timesteps", "stop after N steps", whole_number(1, besides={-1: "never"}), -1),
        flag("--n-episodes", "episodes to play (default: 10, or as many as -n allows)", cli.COUNT),
        flag("--n-envs", "environments to play on at once (1)", cli.COUNT, 1),
        flag("--seed", "seed of the episodes (default: 0; -1: a random one)", cli.SEED, 0),
        flag("--render", "default: human with a display, else none", choices=RENDERED),
        flag("--no-render", "--render none", action="store_const", const="none", dest="render"),
        flag("--record", "write a film (.gif)", metavar="FILE"),
        flag("--reward-log", "write the returns there, as Monitor's CSV files", metavar="DIR"),
        flag("--verbose", "0 for no output (default: 1)", cli.VERBOSITY, 1),
        switch("--norm-reward", "returns of normalised rewards, as in training"),
        switch("-P --progress", argparse.SUPPRESS),  # of rl_zoo3, and not needed
        switch("--custom-objects", argparse.SUPPRESS),
    ),
}


def build_parser() -> OneLineParser:
    """The flags, with the names and meanings that rl_zoo3 gives them."""
    words = "Play a trained agent and print the returns of its episodes."
    parser = OneLineParser(words, EPILOG, FLAGS)
    policy = parser.add_mutually_exclusive_group()
    policy.add_argument("--deterministic", action="store_true", help="best actions (default)")
    policy.add_argument("--stochastic", action="store_true", help="sample actions, or explore")
    return parser


def main() -> int:
    """Find a model and play it."""
    args = build_parser().parse_args()
    if args.n_envs > 1 and (args.record is not None or args.render in ("human", "ansi")):
        shown = "--record" if args.record is not None else f"--render {args.render}"
        raise UserError(f"{shown} shows one environment: leave out --n-envs")
    if args.record is not None:
        from rl_yardstick.report.films import check_film_path

        check_film_path(Path(args.record))
    console = TextConsole(quiet=args.verbose < 1)
    play(console, found_model(console, wanted_model(args)), args)
    return 0


def wanted_model(args: argparse.Namespace) -> Wanted:
    """The model that the arguments ask for; imports the modules that were typed."""
    from rl_yardstick.pipeline.models import Wanted
    from rl_yardstick.pipeline.settings import parse_assignments

    cli.import_typed(args)
    cli.check_device(args.device)
    which: Any = "last checkpoint" if args.load_last_checkpoint else "final"
    return Wanted(
        path=None if args.model is None else Path(args.model),
        algo=args.algo,
        env_id=args.env or None,
        log_folder=Path(args.folder),
        number=args.exp_id,
        which="best" if args.load_best else which if (n := args.load_checkpoint) is None else n,
        statistics=args.vec_normalize,
        env_kwargs=parse_assignments(args.env_kwargs, "--env-kwargs"),
        typed=args.gym_packages,
        seed=args.seed if args.seed >= 0 else randbelow(2**31),
        device=args.device,
    )


def found_model(console: Console, wanted: Wanted) -> Model:
    """Find the model and print its place."""
    from rl_yardstick.pipeline.models import find_model

    found = find_model(wanted)
    say(console, f"{found.spec.algo} on {found.spec.env_id}: {found.path}")
    if found.statistics is not None:
        say(console, f"observations normalised by {found.statistics}")
    return found


def render_mode(args: argparse.Namespace) -> RenderMode | None:
    """The render mode: films need ``rgb_array``, and ``human`` by default needs a display."""
    if args.record is not None:
        return "rgb_array"
    if args.render is not None:
        return None if args.render == "none" else args.render
    variables = map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))
    has_display = sys.platform in ("darwin", "win32") or any(variables)
    return "human" if has_display and args.n_envs == 1 else None


def play(console: Console, found: Model, args: argparse.Namespace) -> None:
    """Play episodes, show or film them, and print their returns and the policy's exact return."""
    with console.status("loading the agent"):
        import torch as th

        from rl_yardstick.pipeline.models import load_agent
        from rl_yardstick.pipeline.playing import play_episodes, playing_env

        if args.num_threads > 0:
            th.set_num_threads(args.num_threads)
        returns = Path(args.reward_log) if args.reward_log else None
        spec, mode = found.spec, render_mode(args)
        env: Any = playing_env(found, mode, args.n_envs, returns, args.norm_reward)
        agent = load_agent(found, env)
        env.seed(spec.seed)
    show = Show(console, env, agent, mode)
    n_steps = args.n_timesteps if args.n_timesteps > 0 else None
    n_episodes = 10 if args.n_episodes is None and n_steps is None else args.n_episodes
    given: Any = {"before_step": show.before_step, "after_step": show.after_step}
    given |= {"deterministic": not args.stochastic}
    with show.live if mode == "ansi" else console.status("playing"):
        for total, length, _ in play_episodes(agent, env, n_episodes, n_steps, **given):
            show.after_episode(total, length)
    env.close()
    if args.record is not None:
        with console.status("writing the film"):
            from rl_yardstick.report.films import write_film

            write_film(Path(args.record), show.frames)
        say(console, f"film: {args.record}")
    with console.status("computing the policy's expected return"):
        lines = played_lines(spec, show, args.norm_reward)
        lines += expected_lines(spec, agent, not args.stochastic)
    say(console, "\n".join(lines))


def played_lines(spec: TrainSpec, show: Show, is_normalised: bool) -> list[str]:
    """The mean return, beside the optimum if a bracket of that is known."""
    if not show.played:
        return ["no episode came to its end: raise --n-timesteps"]
    import numpy as np

    from rl_yardstick.pipeline.evaluation.sampled import bracketed_yardstick
    from rl_yardstick.pipeline.evaluation.yardstick import Evaluation

    returns, lengths = np.array(show.played, dtype=np.float64).T
    yardstick = None if is_normalised else bracketed_yardstick(spec)
    played = Evaluation(returns, lengths, None, yardstick=yardstick)
    return result_lines(played, f"length {figures(played.mean_length)[0]}")


def expected_lines(spec: TrainSpec, agent: Any, deterministic: bool) -> list[str]:
    """The policy's exact evaluation, or why figures are sampled; empty if the model is unknown."""
    from rl_yardstick.agents.policies import why_not_exact
    from rl_yardstick.pipeline.evaluation.exact import exact_evaluator, model_refusal
    from rl_yardstick.pipeline.evaluation.judge import by_histories, world_of_memory

    world = world_of_memory(spec, agent) if deterministic else None
    if world is not None and (found := by_histories(spec, agent, world)) is not None:
        return result_lines(found)
    evaluator = exact_evaluator(spec)
    if evaluator is None:
        refusal = model_refusal(spec)
        return [f"{refusal}; figures are sampled"] if refusal else []
    if reason := evaluator.obstacle(agent, deterministic):
        return [f"sampled, not exact: {spec.algo}: {reason}"]
    if not why_not_exact(agent, evaluator.observations):
        with suppress(TypeError, ValueError):  # its action probabilities may not be known
            return result_lines(evaluator(agent, deterministic))
    return []


# --- what is shown --------------------------------------------------------------------------------


class Show:
    """Prints episodes as they end, shows frames of text, and keeps those of films.

    On a terminal, each frame of text replaces the last, with the agent's figures beside it.
    """

    def __init__(self, console: Console, env: Any, agent: Any, mode: RenderMode | None) -> None:
        from rich.live import Live

        from rl_yardstick.envs.layout import action_names
        from rl_yardstick.pipeline.playing import FrameTaker

        self.console, self.agent, self.mode = console, agent, mode
        self.taker, self.frames = FrameTaker(env), list[Any]()
        self.played: list[tuple[float, int]] = []  # returns and lengths of episodes
        self.step = 0  # of the episode
        self.is_live = mode == "ansi" and console.is_terminal and not console.quiet
        live = Live(console=console, auto_refresh=False, vertical_overflow="crop")
        self.live: Any = live if self.is_live else nullcontext()
        self.names = action_names(env.unwrapped.envs[0]) if self.is_live else ()

    def before_step(self, obs: Any, actions: Any) -> None:
        """Draw the state with a figure for each action, and mark the chosen one."""
        from rich.table import Table

        from rl_yardstick.agents.policies import action_figures

        if not self.is_live:
            return
        table, figures = Table.grid(padding=(0, 1)), action_figures(self.agent, obs)
        if figures is not None:
            table.add_row("", "action", figures[0], style="dim")
            for action, number in enumerate(figures[1]):
                name = self.names[action] if action < len(self.names) else str(action)
                mark = ">" if action == int(actions.reshape(-1)[0]) else ""
                table.add_row(mark, name, f"{number:.4g}")
        self.draw(self.taker.take(done=False), table)

    def after_step(self, done: bool) -> None:
        """Show or keep the frames; of a live picture, the last one of an episode."""
        self.step += 1
        if self.mode == "rgb_array":
            self.frames += self.taker.take(done)
        elif self.is_live and done:
            self.draw(self.taker.take(done), "")
        elif self.mode == "ansi" and not self.is_live:
            for text in self.taker.take(done):
                self.console.file.write(f"{text}\n")  # with its colours
        self.step = 0 if done else self.step

    def after_episode(self, total_return: float, length: int) -> None:
        """Print an episode's return and length."""
        self.played.append((total_return, length))
        told = f"episode {len(self.played)}: return {total_return:.2f}, {length} steps"
        self.console.print(told, soft_wrap=True)

    def draw(self, frames: Sequence[str], beside: Any) -> None:
        """Draw the title and the last frame in place of those before."""
        from rich.columns import Columns
        from rich.console import Group
        from rich.text import Text

        title = Text(f"episode {len(self.played) + 1}, step {self.step}", style="dim")
        picture = Text.from_ansi(frames[-1].rstrip("\n"), no_wrap=True, overflow="crop")
        self.live.update(Group(title, Columns([picture, beside], padding=(0, 3))), refresh=True)
        time.sleep(1 / FRAMES_PER_SECOND)
