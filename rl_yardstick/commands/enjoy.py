"""``enjoy.py``: its flags, the model they select, and how it is shown."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands.cli import (
    COUNT,
    COUNT_OR_NONE,
    SEED,
    VERBOSITY,
    OneLineParser,
    add_shared,
    called_as,
    check_device,
    filled,
    go_on_unread,
    whole_number,
)
from rl_yardstick.pipeline import loading_libraries
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.failures import exits_as_mistakes
from rl_yardstick.pipeline.stopping import stops_noticed

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table
    from stable_baselines3.common.base_class import BaseAlgorithm

    from rl_yardstick.pipeline.evaluation.policies import ActionFigures
    from rl_yardstick.pipeline.models.choose import ChosenModel, ModelRequest
    from rl_yardstick.pipeline.models.find import Which
    from rl_yardstick.pipeline.playing import FrameTaker, RenderMode, Repetition
    from rl_yardstick.pipeline.signs_of_life import Activity
    from rl_yardstick.pipeline.train_spec import TrainSpec

# --- flags ----------------------------------------------------------------------------------------

FRAMES = whole_number(1, 60)
FRAMES_PER_SECOND = 4
STEPS = whole_number(1, besides={-1: "as many as the episodes take"})
RUN_NUMBER = whole_number(0, besides={-1: "the run without a number"})

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
        description="Play a trained agent and print the returns of its episodes.",
        epilog=EPILOG,
    )
    add_model_flags(parser)
    group = parser.add_argument_group("playing")
    add = group.add_argument
    steps = "stop after this many steps"
    add("-n", "--n-timesteps", type=STEPS, default=-1, metavar="N", help=steps)
    episodes = "episodes to play (default: 10, or as many as end within the steps of -n)"
    add("--n-episodes", type=COUNT, metavar="N", help=episodes)
    add(
        "--n-envs",
        type=COUNT,
        default=1,
        metavar="N",
        help="environments to play on at once, each an equal share of the episodes (default: 1)",
    )
    policy = parser.add_mutually_exclusive_group()
    best = "the policy's best actions (default)"
    policy.add_argument("--deterministic", action="store_true", help=best)
    policy.add_argument("--stochastic", action="store_true", help="sample actions, or explore")
    add("--seed", type=SEED, default=0, help="seed of the episodes (default: 0; -1: a random one)")
    watched = "how to watch (default: human if there is a display, else none)"
    add("--render", choices=["human", "ansi", "none"], help=watched)
    add("--no-render", action="store_const", const="none", dest="render", help="--render none")
    pace = "pictures a second of --render ansi on a terminal (default: 4)"
    add("--fps", type=FRAMES, default=None, metavar="N", help=pace)
    add("--record", type=filled, metavar="FILE", help="write a film, .gif or .mp4")
    add("--reward-log", metavar="DIR", help="also write the returns there, as Monitor's CSV files")
    add("--verbose", type=VERBOSITY, default=1, help="0 for no output (default: 1)")
    add("--norm-reward", action="store_true", help="returns of normalised rewards, as in training")
    add_shared(group, "--env-kwargs", "--gym-packages")
    # Flags of rl_zoo3 without an effect: `check_playing` refuses -P; loading always does what
    # --custom-objects asks for.
    parser.add_argument("-P", "--progress", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--custom-objects", action="store_true", help=argparse.SUPPRESS)
    return parser


def add_model_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that select an agent."""
    add = parser.add_argument
    zipped = "path of a model zip, a run folder or a pack (default: a run is looked for)"
    add("model", nargs="?", help=zipped)
    add("--algo", type=filled, help="agent (default: ppo, or what the zip's run folder says)")
    env = "environment id (default: CartPole-v1, or what the run folder says)"
    add("--env", type=filled, help=env)
    add("-f", "--folder", type=filled, default="logs", help="folder of all runs (default: logs)")
    add(
        "--exp-id",
        type=RUN_NUMBER,
        default=0,
        metavar="N",
        help="number of the run (default: 0, the newest; -1 for FOLDER/ALGO/ENV.zip itself)",
    )
    add("--load-best", action="store_true", help="the model with the best evaluation in training")
    checkpoint = "the checkpoint after that many steps"
    add("--load-checkpoint", type=COUNT_OR_NONE, metavar="STEPS", help=checkpoint)
    add("--load-last-checkpoint", action="store_true", help="the last checkpoint")
    statistics = "statistics of VecNormalize (default: those saved with the model)"
    add("--vec-normalize", metavar="FILE", help=statistics)
    add_shared(parser, "--device", "--num-threads")


# --- main -----------------------------------------------------------------------------------------


def main() -> int:
    """Parse the arguments and play; return the exit code."""
    args = build_parser().parse_args()
    with stops_noticed(), exits_as_mistakes():
        from rl_yardstick.commands.terminal import TextConsole
        from rl_yardstick.pipeline.playing import check_film_path

        check_playing(args)
        if args.record is not None:
            check_film_path(Path(args.record))
        console = TextConsole(highlight=False, quiet=args.verbose < 1)
        with ExitStack() as stack:
            chosen = found_model(console, model_request(args), stack)
            if args.record is not None or args.reward_log:
                go_on_unread()
            play(console, chosen, args)
    return 0


def check_playing(args: argparse.Namespace) -> None:
    """Raise `UserError` for flags that do not fit together."""
    if args.progress:
        raise UserError("-P: there is no bar; each episode is printed as it ends")
    if args.fps is not None and args.render != "ansi":
        raise UserError("--fps is the pace of --render ansi: give that too")
    if args.n_envs > 1 and (args.record is not None or args.render in ("human", "ansi")):
        flag = "--record" if args.record is not None else f"--render {args.render}"
        raise UserError(f"{flag} shows one environment: leave out --n-envs")


def model_request(args: argparse.Namespace) -> ModelRequest:
    """The model that the arguments ask for."""
    from secrets import randbelow

    from rl_yardstick.pipeline.models.choose import ModelRequest
    from rl_yardstick.pipeline.settings.values import parse_assignments
    from rl_yardstick.pipeline.user_modules import import_typed

    check_device(args.device)
    which: Which = "last checkpoint" if args.load_last_checkpoint else "final"
    if args.load_best:
        which = "best"
    elif args.load_checkpoint is not None:
        which = int(args.load_checkpoint)
    return ModelRequest(
        path=None if args.model is None else Path(args.model),
        algo=args.algo,
        env_id=args.env,
        log_folder=Path(args.folder),
        run_number=args.exp_id,
        which=which,
        statistics=None if args.vec_normalize is None else Path(args.vec_normalize),
        env_kwargs=parse_assignments(args.env_kwargs, "--env-kwargs"),
        user_modules=import_typed(args.gym_packages, [args.env or ""]),
        seed=args.seed if args.seed >= 0 else randbelow(2**31),
        device=args.device,
    )


def found_model(console: Console, wanted: ModelRequest, stack: ExitStack) -> ChosenModel:
    """Find the model, print its place, and load the libraries that play it.

    A pack stays unpacked until ``stack`` is closed.
    """
    from rl_yardstick.commands.terminal import say
    from rl_yardstick.pipeline.models.choose import find_model, with_statistics
    from rl_yardstick.pipeline.packs import unpacked
    from rl_yardstick.pipeline.runs import NoRunError
    from rl_yardstick.pipeline.signs_of_life import doing

    typed = wanted.path
    if typed is not None:
        path, zipped_in = stack.enter_context(unpacked(typed))
        wanted = replace(wanted, path=path, zipped_in=zipped_in)
    try:
        found = find_model(wanted)
    except NoRunError as error:
        flags = f"--algo {error.algo} --env {error.env_id} -f {error.log_folder}"
        raise UserError(f"{error}: train one with: {called_as('train')} {flags}") from error
    place = typed if wanted.zipped_in is not None else found.path
    say(console, f"{found.spec.algo} on {found.spec.env_id}: {place}")
    with doing(console, "loading the libraries"), loading_libraries():
        # Load all libraries now, so that playing does not pause for them.
        return with_statistics(found, wanted.statistics)


# --- playing --------------------------------------------------------------------------------------


def render_mode(args: argparse.Namespace) -> RenderMode | None:
    """The render mode: films need ``rgb_array``, and ``human`` by default needs a display."""
    if args.record is not None:
        return "rgb_array"
    if args.render == "none" or (args.render is None and args.n_envs > 1):
        return None
    if args.render == "ansi":
        return "ansi"
    has_display = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return "human" if args.render == "human" or has_display else None


def play(console: Console, chosen: ChosenModel, args: argparse.Namespace) -> None:
    """Play episodes, show or film them, and print their returns and the policy's exact return."""
    import torch as th

    from rl_yardstick.envs.layout import action_names
    from rl_yardstick.pipeline.environments import lacking_packages_told
    from rl_yardstick.pipeline.models.load import load_to_play, with_normalised_rewards
    from rl_yardstick.pipeline.playing import (
        FrameTaker,
        Repetition,
        play_episodes,
        playing_env,
        write_film,
    )
    from rl_yardstick.pipeline.signs_of_life import Activity, can_move, doing

    if args.num_threads > 0:
        th.set_num_threads(args.num_threads)
    n_steps = args.n_timesteps if args.n_timesteps >= 0 else None
    n_episodes = 10 if args.n_episodes is None and n_steps is None else args.n_episodes
    is_deterministic = not args.stochastic
    spec, mode = chosen.spec, render_mode(args)
    with doing(console, "loading the agent"):
        returns_folder = Path(args.reward_log) if args.reward_log else None
        env: Any = playing_env(chosen, mode, args.n_envs, returns_folder)
        if args.norm_reward:
            env = with_normalised_rewards(env)
        model = load_to_play(spec.algo, chosen.file, env, spec.device, spec.user_modules)
        env.seed(spec.seed)
    show: _Show | LiveShow
    if mode != "ansi" or not can_move(console) or console.quiet:
        show = _Show(Activity(console, "playing"), mode, FrameTaker(env), Repetition())
    else:
        names = action_names(env.unwrapped.envs[0])
        show = LiveShow(console, model, FrameTaker(env), args.fps or FRAMES_PER_SECOND, names)
    with show.shown(), lacking_packages_told(spec.env_id):
        for total_return, length in play_episodes(
            model,
            env,
            n_episodes,
            n_steps,
            deterministic=is_deterministic,
            before_step=show.before_step,
            after_step=show.after_step,
        ):
            show.after_episode(total_return, length)
    env.close()
    if args.record is not None and isinstance(show, _Show):
        film = Path(args.record)
        if not show.frames:
            raise UserError("--record: nothing was played, so there is nothing to film")
        with doing(console, "writing the film"):
            write_film(film, show.frames)
        console.print(f"film: {film}")
        if chosen.run is not None:
            chosen.run.add_file(film)
    print_returns(console, spec, show, are_normalised=args.norm_reward)
    _print_exact(console, spec, model, is_deterministic)


def print_returns(
    console: Console, spec: TrainSpec, show: _Show | LiveShow, *, are_normalised: bool = False
) -> None:
    """Print the mean return, beside the optimum if a bracket of that is known."""
    if not show.returns:
        console.print("no episode came to its end: raise --n-timesteps")
        return
    import numpy as np

    from rl_yardstick.commands.terminal import figures, result_lines
    from rl_yardstick.pipeline.evaluation.sampled import Evaluation, bracketed_yardstick

    played = Evaluation(np.array(show.returns), np.array(show.lengths), None)
    if not are_normalised:
        played = played.measured_by(bracketed_yardstick(spec))
    for line in result_lines(played, f"length {figures(played.mean_length)[0]}"):
        console.print(line)


def _print_exact(console: Console, spec: TrainSpec, model: Any, deterministic: bool) -> None:
    """Print the expected return of the policy, if it can be computed."""
    from rl_yardstick.commands.terminal import print_refusal, result_lines
    from rl_yardstick.pipeline.evaluation.exact import exact_evaluator, model_refusal
    from rl_yardstick.pipeline.evaluation.histories import by_histories, world_of_memory
    from rl_yardstick.pipeline.evaluation.policies import why_not_exact
    from rl_yardstick.pipeline.signs_of_life import doing

    with doing(console, "computing the policy's expected return"):
        world = world_of_memory(spec, model) if deterministic else None
        if world is not None:
            remembering = by_histories(spec, model, world)
            if remembering is not None:
                for line in result_lines(remembering):
                    console.print(line)
                return
        evaluator = exact_evaluator(spec)
        if evaluator is None:
            print_refusal(console, model_refusal(spec))
            return
        obstacle = evaluator.obstacle(model, deterministic)
        if obstacle:
            console.print(f"sampled, not exact: {spec.algo}: {obstacle}", style="dim")
            return
        if why_not_exact(model, evaluator.observations):
            return
        try:
            evaluation = evaluator(model, deterministic)
        except (TypeError, ValueError):
            # The agent's action probabilities are not known.
            return
    for line in result_lines(evaluation):
        console.print(line)


@dataclass
class _Show:
    """Prints or keeps the frames as they come, and reports progress."""

    activity: Activity
    mode: RenderMode | None
    taker: FrameTaker
    repetition: Repetition
    frames: list[Any] = field(default_factory=list)
    steps: int = 0
    returns: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    n_left_out: int = 0  # pictures

    def shown(self) -> AbstractContextManager[None]:
        # Frames as text show progress by themselves.
        return nullcontext() if self.mode == "ansi" else self.activity.shown()

    def before_step(self, obs: Any, actions: Any) -> None:
        """Do nothing: frames are shown after the step."""

    def after_step(self, done: bool) -> None:
        self.steps += 1
        n_ended = len(self.returns)
        ended = f"{n_ended:,} episode{'s' if n_ended != 1 else ''}"
        self.activity.at(f"{self.steps:,} steps, {ended}")
        if self.mode == "rgb_array":
            self.frames += self.taker.take(done)
        elif self.mode == "ansi":
            for text in self.taker.take(done):
                if self.repetition.goes_on(text):
                    self.n_left_out += 1
                else:
                    self._tell_left_out()
                    self.activity.console.file.write(f"{text}\n")
            if done:
                self._tell_left_out()
                self.repetition.forget()

    def _tell_left_out(self) -> None:
        if self.n_left_out:
            steps = f"{self.n_left_out:,} step{'s' if self.n_left_out > 1 else ''}"
            self.activity.say(f"... {steps} left out, which repeat pictures from above")
        self.n_left_out = 0

    def after_episode(self, total_return: float, length: int) -> None:
        self.returns.append(total_return)
        self.lengths.append(length)
        self.activity.say(f"episode {len(self.returns)}: return {total_return:.2f}, {length} steps")


# --- a live picture in the terminal ---------------------------------------------------------------


# Widths in characters: a bar, a number such as -1.235e-05 or "probability", the table, the gap.
BAR = 12
NUMBER = 11
FIGURES_WIDTH = 36
GAP = 3
# In lines: the title above the map, the heading of the table, and one for the cursor.
HEADINGS = 3
MOST_ACTIONS = 20


class LiveShow:
    """Draws the environment as text, beside the agent's values or probabilities of actions."""

    def __init__(
        self,
        console: Console,
        model: BaseAlgorithm,
        taker: FrameTaker,
        fps: float,
        names: tuple[str, ...] = (),
    ) -> None:
        from rich.live import Live

        from rl_yardstick.pipeline.playing import Repetition

        self.taker = taker  # takes the environment's frames
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self._model = model
        self._names = names
        self._pause = 1.0 / fps
        self._step = 0  # of the episode
        self._repetition = Repetition()
        self._is_left_out = False
        self._live = Live(console=console, auto_refresh=False, vertical_overflow="crop")

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Draw while the ``with`` statement runs; the last picture stays."""
        with self._live:
            yield
            if self._step:  # at 0 the end of an episode is shown already
                self._draw(self.taker.take(done=False), None, None)

    def before_step(self, obs: Any, actions: Any) -> None:
        """Draw the state and the chosen action."""
        import numpy as np

        from rl_yardstick.pipeline.evaluation.policies import action_figures

        frames = self.taker.take(done=False)
        if frames and self._repetition.goes_on(frames[-1]):
            if not self._is_left_out:
                self._say(f"step {self._step}: the frames repeat, and are no longer shown")
            self._is_left_out = True
            return
        self._is_left_out = False
        figures = action_figures(self._model, obs)
        chosen = int(np.asarray(actions).reshape(-1)[0]) if figures is not None else None
        self._draw(frames, figures, chosen)
        time.sleep(self._pause)

    def after_step(self, done: bool) -> None:
        """Draw the last state of an episode."""
        self._step += 1
        if done:
            self._draw(self.taker.take(done=True), None, None)
            time.sleep(self._pause)
            self._step = 0
            self._repetition.forget()

    def after_episode(self, total_return: float, length: int) -> None:
        """Print an episode's return and length above the picture."""
        self.returns.append(total_return)
        self.lengths.append(length)
        self._say(f"episode {len(self.returns)}: return {total_return:.2f}, {length} steps")

    def _say(self, line: str) -> None:
        from rl_yardstick.commands.terminal import say

        say(self._live.console, line)

    def _draw(self, frames: list[Any], figures: ActionFigures | None, chosen: int | None) -> None:
        if frames:
            self._live.update(self._picture(str(frames[-1]), figures, chosen), refresh=True)

    def _picture(
        self, frame: str, figures: ActionFigures | None, chosen: int | None
    ) -> RenderableType:
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        drawn = Text.from_ansi(frame.rstrip("\n"), no_wrap=True, overflow="crop")
        title = Text(f"episode {len(self.returns) + 1}, step {self._step}", style="dim")
        if figures is None or chosen is None:
            return Group(title, drawn)
        lines = drawn.split()
        width = max((line.cell_len for line in lines), default=0)
        columns, rows = self._live.console.width, self._live.console.height - HEADINGS
        is_beside = width + GAP + FIGURES_WIDTH <= columns
        if is_beside:
            columns -= width + GAP
        else:
            rows -= len(lines)
        table = figures_table(figures, chosen, self._names, min(rows, MOST_ACTIONS), columns)
        if not is_beside:
            return Group(title, drawn, table)
        beside = Table.grid(padding=(0, GAP))
        beside.add_row(drawn, table)
        return Group(title, beside)


def figures_table(
    figures: ActionFigures,
    chosen: int,
    names: tuple[str, ...],
    n_shown: int = MOST_ACTIONS,
    width: int = FIGURES_WIDTH,
) -> Table:
    """A row for each action, with a bar between the lowest and the highest; the chosen one marked.

    Columns have fixed widths, so that the table does not move. If not all actions fit, the table
    has the first ones and the chosen one.
    """
    import numpy as np
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    n_shown = max(n_shown, 1)
    shown = [*range(min(n_shown, len(figures.numbers)))]
    if chosen not in shown:
        shown[-1] = chosen
    words = [names[action] if action < len(names) else str(action) for action in shown]
    longest = max(map(cell_len, ["action", *words]))
    bar = max(min(BAR, width - longest - NUMBER - 4), 0)
    table = Table.grid(padding=(0, 1))
    for columns in (1, longest, NUMBER, bar):
        table.add_column(width=columns, no_wrap=True, overflow="crop")
    table.add_row("", "action", figures.word, "", style="dim")
    low, high = float(np.min(figures.numbers)), float(np.max(figures.numbers))
    low = 0.0 if figures.word == "probability" else low
    for action, name in zip(shown, words, strict=True):
        number = float(figures.numbers[action])
        share = (number - low) / (high - low) if 0 < high - low < np.inf else 0.0
        mark, style = (">", "bold") if action == chosen else (" ", "")
        table.add_row(
            mark, Text(name), f"{number:.4g}", Text("#" * round(bar * share)), style=style
        )
    return table
