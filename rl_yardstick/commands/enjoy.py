"""``enjoy.py``: its flags, the model that they select, and how it is shown."""

from __future__ import annotations

import argparse
import os
import sys
import time
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands.cli import (
    COUNT,
    SEED,
    VERBOSITY,
    OneLineParser,
    add_shared,
    check_device,
    filled,
    whole_number,
)
from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from rl_yardstick.pipeline.evaluation.policies import ActionFigures
    from rl_yardstick.pipeline.evaluation.sampled import Evaluation
    from rl_yardstick.pipeline.models import Model, Wanted
    from rl_yardstick.pipeline.playing import RenderMode
    from rl_yardstick.pipeline.spec import TrainSpec

FRAMES_PER_SECOND = 4  # of --render ansi
LONGEST_REPETITION = 20  # frames of an episode in a row that were all shown before

EPILOG = """\
examples:
  python enjoy.py --env Warehouse-v0 --algo ppo
  python enjoy.py --env FrozenLake-v1 --algo qlearning --load-best --n-episodes 1000 --render none
  python enjoy.py --env Warehouse-v0 --algo sarsa --record route.gif --n-episodes 1
  python enjoy.py logs/dqn/CartPole-v1_3/rl_model_20000_steps.zip
  python enjoy.py --algo ppo --env MountainCar-v0 -f rl-trained-agents
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags, with the names and meanings that rl_zoo3 gives them."""
    parser = OneLineParser(
        description="Play a trained agent and print the returns of its episodes.", epilog=EPILOG
    )
    add_model_flags(parser)
    group = parser.add_argument_group("playing")
    add = group.add_argument
    steps = whole_number(1, besides={-1: "as many as the episodes take"})
    add("-n", "--n-timesteps", type=steps, default=-1, metavar="N", help="stop after N steps")
    episodes = "episodes to play (default: 10, or as many as end within the steps of -n)"
    add("--n-episodes", type=COUNT, metavar="N", help=episodes)
    add("--n-envs", type=COUNT, default=1, metavar="N", help="environments to play on at once (1)")
    policy = parser.add_mutually_exclusive_group()
    policy.add_argument("--deterministic", action="store_true", help="best actions (default)")
    policy.add_argument("--stochastic", action="store_true", help="sample actions, or explore")
    add("--seed", type=SEED, default=0, help="seed of the episodes (default: 0; -1: a random one)")
    watched = "how to watch (default: human if there is a display, else none)"
    add("--render", choices=["human", "ansi", "none"], help=watched)
    add("--no-render", action="store_const", const="none", dest="render", help="--render none")
    pace = f"pictures a second of --render ansi on a terminal (default: {FRAMES_PER_SECOND})"
    add("--fps", type=whole_number(1, 60), metavar="N", help=pace)
    add("--record", type=filled, metavar="FILE", help="write a film, .gif")
    add("--reward-log", metavar="DIR", help="also write the returns there, as Monitor's CSV files")
    add("--verbose", type=VERBOSITY, default=1, help="0 for no output (default: 1)")
    add("--norm-reward", action="store_true", help="returns of normalised rewards, as in training")
    add_shared(group, "--env-kwargs", "--gym-packages")
    for flag in (["-P", "--progress"], ["--custom-objects"]):  # rl_zoo3's, which are not needed
        parser.add_argument(*flag, action="store_true", help=argparse.SUPPRESS)
    return parser


def add_model_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that select an agent."""
    add = parser.add_argument
    add("model", nargs="?", help="a model zip or a run folder (default: a run is looked for)")
    add("--algo", type=filled, help="agent (default: ppo, or as in the zip's run folder)")
    add("--env", type=filled, help="environment id (default: CartPole-v1, or as in the folder)")
    add("-f", "--folder", type=filled, default="logs", help="folder of all runs (default: logs)")
    number = "number of the run (default: 0, the newest; -1 for FOLDER/ALGO/ENV.zip itself)"
    numbers = whole_number(0, besides={-1: "the run without a number"})
    add("--exp-id", type=numbers, default=0, metavar="N", help=number)
    add("--load-best", action="store_true", help="the model with the best evaluation in training")
    add("--load-checkpoint", type=whole_number(0), metavar="STEPS", help="that checkpoint")
    add("--load-last-checkpoint", action="store_true", help="the last checkpoint")
    statistics = "statistics of VecNormalize (default: those saved with the model)"
    add("--vec-normalize", type=Path, metavar="FILE", help=statistics)
    add_shared(parser, "--device", "--num-threads")


def main() -> int:
    """Find a model and play it."""
    args = build_parser().parse_args()

    from rl_yardstick.commands.terminal import TextConsole
    from rl_yardstick.pipeline.playing import check_film_path

    if args.fps is not None and args.render != "ansi":
        raise UserError("--fps is the pace of --render ansi: give that too")
    if args.n_envs > 1 and (args.record is not None or args.render in ("human", "ansi")):
        flag = "--record" if args.record is not None else f"--render {args.render}"
        raise UserError(f"{flag} shows one environment: leave out --n-envs")
    if args.record is not None:
        check_film_path(Path(args.record))
    console = TextConsole(quiet=args.verbose < 1)
    play(console, found_model(console, wanted_model(args)), args)
    return 0


def wanted_model(args: argparse.Namespace) -> Wanted:
    """The model that the arguments ask for; imports the modules that were typed."""
    from secrets import randbelow

    from rl_yardstick.pipeline.components import import_modules, split_id
    from rl_yardstick.pipeline.models import Wanted
    from rl_yardstick.pipeline.settings import parse_assignments

    module, env_id = split_id(args.env or "")
    typed = [*args.gym_packages, *filter(None, [module])]
    import_modules(typed)
    check_device(args.device)
    which: Any = "last checkpoint" if args.load_last_checkpoint else "final"
    return Wanted(
        path=None if args.model is None else Path(args.model),
        algo=args.algo,
        env_id=env_id or None,
        log_folder=Path(args.folder),
        number=args.exp_id,
        which="best" if args.load_best else which if (n := args.load_checkpoint) is None else n,
        statistics=args.vec_normalize,
        env_kwargs=parse_assignments(args.env_kwargs, "--env-kwargs"),
        typed=typed,
        seed=args.seed if args.seed >= 0 else randbelow(2**31),
        device=args.device,
    )


def found_model(console: Console, wanted: Wanted) -> Model:
    """Find the model and print its place."""
    from rl_yardstick.commands.terminal import say
    from rl_yardstick.pipeline.models import find_model

    found = find_model(wanted)
    say(console, f"{found.spec.algo} on {found.spec.env_id}: {found.path}")
    return found


def render_mode(args: argparse.Namespace) -> RenderMode | None:
    """The render mode: films need ``rgb_array``, and ``human`` by default needs a display."""
    if args.record is not None:
        return "rgb_array"
    if args.render == "ansi":
        return "ansi"
    has_display = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    is_shown = has_display and args.render is None and args.n_envs == 1
    return "human" if is_shown or args.render == "human" else None


def play(console: Console, found: Model, args: argparse.Namespace) -> None:
    """Play episodes, show or film them, and print their returns and the policy's exact return."""
    with console.status("loading the agent"):
        import torch as th
        from gymnasium.error import DependencyNotInstalled

        from rl_yardstick.commands.terminal import result_lines, say
        from rl_yardstick.pipeline.models import load_agent
        from rl_yardstick.pipeline.playing import play_episodes, playing_env, write_film

        if args.num_threads > 0:
            th.set_num_threads(args.num_threads)
        returns = Path(args.reward_log) if args.reward_log else None
        spec, mode = found.spec, render_mode(args)
        env: Any = playing_env(found, mode, args.n_envs, returns, args.norm_reward)
        agent = load_agent(found, env)
        env.seed(spec.seed)
    is_live = mode == "ansi" and console.is_terminal and not console.quiet
    show = LiveShow(console, env, agent, args.fps) if is_live else Show(console, env, mode)
    n_steps = args.n_timesteps if args.n_timesteps > 0 else None
    n_episodes = 10 if args.n_episodes is None and n_steps is None else args.n_episodes
    given: Any = {"before_step": show.before_step, "after_step": show.after_step}
    given |= {"deterministic": not args.stochastic}
    try:
        with console.status("playing") if mode != "ansi" else show.live:
            for episode in play_episodes(agent, env, n_episodes, n_steps, **given):
                show.after_episode(*episode)
            show.finish()
    except DependencyNotInstalled as error:  # noticed at the first picture
        raise UserError(f"{spec.env_id}: {error}") from error
    env.close()
    if args.record is not None:
        with console.status("writing the film"):
            write_film(Path(args.record), show.frames)
        say(console, f"film: {args.record}")
    for line in played_lines(spec, show, args.norm_reward):
        say(console, line)
    with console.status("computing the policy's expected return"):
        exact = expected_return(spec, agent, not args.stochastic)
    for line in [exact] if isinstance(exact, str) else result_lines(exact) if exact else []:
        say(console, line)


def played_lines(spec: TrainSpec, show: Show, is_normalised: bool) -> list[str]:
    """The mean return, beside the optimum if a bracket of that is known."""
    if not show.played:
        return ["no episode came to its end: raise --n-timesteps"]
    import numpy as np

    from rl_yardstick.commands.terminal import figures, result_lines
    from rl_yardstick.pipeline.evaluation.sampled import Evaluation, bracketed_yardstick

    returns, lengths = np.array(show.played, dtype=np.float64).T
    yardstick = None if is_normalised else bracketed_yardstick(spec)
    played = Evaluation(returns, lengths, None, yardstick=yardstick)
    return result_lines(played, f"length {figures(played.mean_length)[0]}")


def expected_return(spec: TrainSpec, agent: Any, deterministic: bool) -> Evaluation | str | None:
    """The policy's exact evaluation; or a line on why figures are sampled; None if unknown."""
    from rl_yardstick.pipeline.evaluation.exact import exact_evaluator, model_refusal
    from rl_yardstick.pipeline.evaluation.judge import by_histories, world_of_memory
    from rl_yardstick.pipeline.evaluation.policies import why_not_exact

    world = world_of_memory(spec, agent) if deterministic else None
    if world is not None and (found := by_histories(spec, agent, world)) is not None:
        return found
    evaluator = exact_evaluator(spec)
    if evaluator is None:
        refusal = model_refusal(spec)
        return None if refusal is None else f"{refusal}; figures are sampled"
    if reason := evaluator.obstacle(agent, deterministic):
        return f"sampled, not exact: {spec.algo}: {reason}"
    if not why_not_exact(agent, evaluator.observations):
        with suppress(TypeError, ValueError):  # its action probabilities may not be known
            return evaluator(agent, deterministic)
    return None


# --- what is shown --------------------------------------------------------------------------------


class Show:
    """Prints episodes as they end, prints frames of text, and keeps those of films."""

    live: Any = nullcontext()

    def __init__(self, console: Console, env: Any, mode: RenderMode | None) -> None:
        from rl_yardstick.pipeline.playing import FrameTaker

        self.console, self.mode, self.taker = console, mode, FrameTaker(env)
        self.frames: list[Any] = []
        self.played: list[tuple[float, int]] = []  # returns and lengths of episodes
        self.step = 0  # of the episode
        self._seen: set[Any] = set()  # frames of the episode
        self._n_known = 0  # consecutive ones

    def before_step(self, obs: Any, actions: Any) -> None:
        """Frames are shown after the step."""

    def after_step(self, done: bool) -> None:
        """Show or keep the frames."""
        self.step += 1
        if self.mode == "rgb_array":
            self.frames += self.taker.take(done)
        elif self.mode == "ansi":
            for text in filter(self.is_new, self.taker.take(done)):
                self.console.file.write(f"{text}\n")  # with its colours

    def after_episode(self, total_return: float, length: int) -> None:
        """Print an episode's return and length."""
        self.played.append((total_return, length))
        told = f"episode {len(self.played)}: return {total_return:.2f}, {length} steps"
        self.console.print(told, soft_wrap=True)
        self._seen.clear()
        self.step = self._n_known = 0

    def finish(self) -> None:
        """Show the last state, if no episode ended there."""

    def is_new(self, frame: Any) -> bool:
        """Whether to show a frame: not where the episode only repeats earlier ones."""
        self._n_known = self._n_known + 1 if frame in self._seen else 0
        self._seen.add(frame)
        if self._n_known == LONGEST_REPETITION + 1:
            told = f"step {self.step}: the frames repeat, and are no longer shown"
            self.console.print(told, soft_wrap=True)
        return self._n_known <= LONGEST_REPETITION


class LiveShow(Show):
    """Draws the environment as text on a terminal, beside the agent's figures of its actions."""

    def __init__(self, console: Console, env: Any, agent: Any, fps: int | None) -> None:
        from rich.live import Live

        from rl_yardstick.envs.layout import action_names

        super().__init__(console, env, "ansi")
        self.agent, self.pause = agent, 1 / (fps or FRAMES_PER_SECOND)
        self.names = action_names(env.unwrapped.envs[0])
        self.live = Live(console=console, auto_refresh=False, vertical_overflow="crop")

    def before_step(self, obs: Any, actions: Any) -> None:
        """Draw the state, and mark the chosen action."""
        from rl_yardstick.pipeline.evaluation.policies import action_figures

        frames = self.taker.take(done=False)
        if frames and self.is_new(frames[-1]):
            self.draw(frames[-1], action_figures(self.agent, obs), actions)

    def after_step(self, done: bool) -> None:
        """Draw the last state of an episode."""
        self.step += 1
        if done:
            self.draw(self.taker.take(done=True)[-1], None, None)

    def finish(self) -> None:
        """Draw the last state."""
        if self.step and (frames := self.taker.take(done=False)):
            self.draw(frames[-1], None, None)

    def draw(self, frame: str, figures: ActionFigures | None, actions: Any) -> None:
        """Draw the title, the map and a table of the actions, beside it if there is room."""
        from rich.columns import Columns
        from rich.console import Group
        from rich.text import Text

        title = Text(f"episode {len(self.played) + 1}, step {self.step}", style="dim")
        drawn: list[Any] = [Text.from_ansi(frame.rstrip("\n"), no_wrap=True, overflow="crop")]
        if figures is not None:
            chosen = int(actions.reshape(-1)[0])
            drawn.append(figures_table(figures, chosen, self.names, self.console.height - 3))
        self.live.update(Group(title, Columns(drawn, padding=(0, 3))), refresh=True)
        time.sleep(self.pause)


def figures_table(
    figures: ActionFigures, chosen: int, names: tuple[str, ...], n_rows: int
) -> Table:
    """A row for each action, with a bar between the lowest and the highest; the chosen one marked.

    If not all actions fit, the table has the first ones and the chosen one.
    """
    import numpy as np
    from rich.table import Table

    shown = [*range(min(len(figures.numbers), max(min(n_rows, 20), 1)))]
    if chosen not in shown:
        shown[-1] = chosen
    low, high = float(np.min(figures.numbers)), float(np.max(figures.numbers))
    low = 0.0 if figures.word == "probability" else low
    table = Table.grid(padding=(0, 1))
    for width in (1, None, 11, 12):  # fixed, so that the table does not move
        table.add_column(width=width, no_wrap=True, overflow="crop")
    table.add_row("", "action", figures.word, "", style="dim")
    for action in shown:
        name = names[action] if action < len(names) else str(action)
        number = float(figures.numbers[action])
        share = (number - low) / (high - low) if 0 < high - low < np.inf else 0.0
        mark, style = (">", "bold") if action == chosen else (" ", "")
        table.add_row(mark, name, f"{number:.4g}", "#" * round(12 * share), style=style)
    return table
