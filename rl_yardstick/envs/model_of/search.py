"""All states, and the outcomes of each action in each of them.

The draws of a step form a tree; `Tree` adds up the probabilities of its leaves. A loop that draws
until it likes the result comes back to the same place in the code. If what can follow the second
visit equals what can follow the first, the tree is cut there, and the probability of coming back is
shared out among the other outcomes, which is exact.
"""

from __future__ import annotations

import copy
import itertools
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from rl_yardstick.envs.model_of.draws import CUT_OFF, NEVER, Again, Script, Suspect, take_step
from rl_yardstick.envs.model_of.states import Place, Refuted, State
from rl_yardstick.envs.model_of.symbols import Drawn, Limit, Stop, stopwatch
from rl_yardstick.mdp.transition_model import Bools, TransitionModel

MOST_ENTRIES = 100_000_000  # of the arrays of a model
MOST_SPANS = 1000  # times at which one action can do different things, if episodes have no end
LEVELS = (1e-6, *np.linspace(0.01, 0.99, 49).tolist(), 1 - 1e-6)


class Outcome(NamedTuple):
    """What a run came to; ``state`` is the number of the next state, -1 where the episode ended."""

    state: int
    reward: float
    variance: float = 0.0
    terminated: bool = False
    truncated: bool = False


Chances = dict[Any, float]  # of outcomes
Spans = list[tuple[int, Chances]]  # what an action does from a time on, until the next entry


@dataclass
class Tree:
    """The tree of draws below one action in one state."""

    run: Callable[[list[int], int, dict[Any, bool]], Outcome]
    script: Script
    loops: dict[Any, bool] = field(default_factory=dict)

    def outcomes(self) -> Chances:
        """The probability of each outcome."""
        while True:
            try:
                chances = self._below([], 0, [])
            except Suspect as suspect:
                self._judge(*suspect.args)
            else:
                rest = 1 - chances.pop(CUT_OFF, 0.0)
                return {outcome: p / rest for outcome, p in chances.items()}

    def _below(
        self, choices: list[int], root: int, back: list[list[int]], leaf: Any = None
    ) -> Chances:
        """The chances of the outcomes below these choices, and of coming back to each node above.

        ``back`` collects the runs that came back; ``leaf`` is a run that began with the choices:
        its outcome, or the node that it came back to, and its trace.
        """
        if leaf is None:
            try:
                outcome: Any = self.run(choices, root, self.loops)
            except Again as again:
                outcome = again.args[0]
            leaf = outcome, self.script.trace
        outcome, trace = leaf
        depth = len(choices)
        if len(trace) == depth:
            if isinstance(outcome, int) and outcome != CUT_OFF:
                back.append(choices)
            return {outcome: 1.0}
        chosen, shares = trace[depth]
        total: Chances = defaultdict(float)
        for choice, p in enumerate(shares):
            if p > 0:
                known = leaf if choice == chosen else None
                for key, share in self._below([*choices, choice], root, back, known).items():
                    total[key] += p * share
        returned = total.pop(depth, 0.0)
        if returned > 1 - 1e-12:
            raise Stop("a loop draws again and again, and never ends")
        return {key: p / (1 - returned) for key, p in total.items()} if returned else total

    def _judge(self, place: Any, first: int, choices: list[int]) -> None:
        """Whether a second visit starts again from the first: then the same must follow both."""
        self.loops[place] = True
        back: list[list[int]] = []
        try:
            one = self._below(choices[:first], first, back)
            others = [self._below(path, len(path), []) for path in [*back[:1], *back[1:][-1:]]]
        except Stop:
            self.loops[place] = False
        except Suspect as inner:  # is judged first
            del self.loops[place]
            self._judge(*inner.args)
        else:
            outcomes = {*one}.union(*others) - {CUT_OFF}
            self.loops[place] = bool(outcomes) and all(
                abs(one.get(key, 0.0) - other.get(key, 0.0)) < 1e-9
                for other in others
                for key in outcomes
            )


@dataclass
class Search:
    """Finds all states of an environment, and the outcomes of all actions."""

    state: State
    actions: list[Any]
    seconds: float
    max_states: int
    progress: Callable[[int, int], None] | None = None
    seeds: Sequence[int] = ()  # of the resets to start from; none for all resets
    put: Callable[[bool], Any] = bool  # lets draws follow the script, or not

    def __post_init__(self) -> None:
        self.spent = stopwatch()

    def run(self) -> tuple[TransitionModel, Bools]:
        """The model and the allowed actions, once no guess about the state proves wrong."""
        while True:
            self.state.guess()
            try:
                self._search()
                return self._model()
            except Refuted as refuted:
                self.state.used.add(refuted.args[0])

    def _search(self) -> None:
        self.index: dict[Hashable, int] = {}
        self.saved: list[bytes] = []
        self.observations: list[Any] = []
        self.rows: list[list[Spans]] = []
        self.illegal: dict[str, int] = {}
        self.end = NEVER - 1  # the time of the last step of the longest episode
        self.runs = 0
        self.initial: Chances = {}
        self.initial = self._starts(self.state.save(self.state.variables()))
        while len(self.rows) < len(self.saved):
            if not any(row := [self._spans(len(self.rows), action) for action in self.actions]):
                if self.state.clocks:
                    raise Refuted(next(iter(self.state.clocks)))
                raise Stop(f"every action fails in a state: {next(iter(self.illegal))}")
            self.rows.append(row)
            often = len(self.rows) == 20 and [len(spans) > 3 for row in self.rows for spans in row]
            if often and np.mean(often) > 0.5:  # time matters all along
                raise Refuted(next(iter(self.state.clocks)))
        self.state.check_constants()
        for outcome in self._starts(self.saved[-1]):  # a reset forgets all
            if outcome not in self.initial:
                self.refuse_start(self.state.contents(self.state.saved(self.saved[outcome.state])))
        if not self.seeds:
            self.refuse_start(self.state.at_first)

    def _starts(self, saved: bytes) -> Chances:
        """The chances of what a reset leads to; with seeds, each is as likely."""
        self.state.script.time = 0
        if not self.seeds:
            return self._outcomes(saved, None)
        chances: Chances = defaultdict(float)
        for seed in self.seeds:
            self.state.restore(saved)
            self.put(False)
            observation, _ = self.state.layers[0].reset(seed=seed)
            self.put(True)
            chances[Outcome(self._number(observation, is_reset=True), 0.0)] += 1 / len(self.seeds)
        return chances

    def refuse_start(self, contents: Iterable[tuple[Place, Hashable]]) -> None:
        """Name the attribute that has a value which it has in no start of an episode."""
        starts = self._values([self.saved[outcome.state] for outcome in self.initial])
        for place, value in contents:
            if place in starts and value not in starts[place]:
                raise Stop(f"`{place[1]}` is kept over `reset` (ignore it if it changes nothing)")

    def _values(self, sample: list[bytes]) -> dict[Place, set[Hashable]]:
        """The values that each attribute has in these states."""
        values: dict[Place, set[Hashable]] = defaultdict(set)
        for saved in sample:
            for place, value in self.state.contents(self.state.saved(saved)):
                values[place].add(value)
        return values

    def _spans(self, state: int, action: Any) -> Spans:
        """What the action does at each time; empty where it is not allowed."""
        spans: Spans = []
        script = self.state.script
        script.time = 0
        while script.time <= self.end:
            time, script.until = script.time, NEVER
            try:
                chances = self._outcomes(self.saved[state], action)
            except Exception as error:
                if time:  # perhaps nothing leads to this state at this time
                    raise Refuted(next(iter(self.state.clocks))) from None
                message = f"{type(error).__name__}: {error}"
                if script.visits:  # no rule of the game: those come before the draws
                    raise Stop(f"{message}, after a random draw") from error
                self.illegal[message] = self.illegal.get(message, 0) + 1
                return []
            spans.append((time, chances))
            if time and all(outcome.state < 0 for outcome in chances):
                if any(outcome.truncated for outcome in chances):
                    self.end = min(self.end, time)
            elif time and time == self.end:
                raise Refuted(next(iter(self.state.clocks)))
            if len(spans) > MOST_SPANS and self.end > NEVER - 2:
                raise Refuted(next(iter(self.state.clocks)))
            script.time = script.until + 1
        return spans

    def _outcomes(self, saved: bytes, action: Any) -> Chances:
        script = self.state.script

        def run(choices: list[int], root: int, loops: dict[Any, bool]) -> Outcome:
            script.begin(choices, root, loops)
            try:
                outcome = self._step(saved, action)
            except Exception:
                if self.state.watched:  # is it what stands in their places that fails?
                    with self.state.plain():
                        script.begin([choice for choice, _ in script.trace], root, loops)
                        self._step(saved, action)
                    raise Refuted(next(iter(self.state.watched))) from None
                raise
            return self._linear(outcome, saved, action) if script.floats else outcome

        chances = Tree(run, script).outcomes()
        self.state.check_constants(in_short=True)
        return chances

    def _step(self, saved: bytes, action: Any) -> Outcome:
        """The outcome of one run under the script; a new state gets the next number."""
        self._tick()
        state = self.state
        state.restore(saved)
        observation, reward, terminated, truncated = take_step(state.layers[0], action)
        reward = reward.item() if isinstance(reward, np.ndarray) else reward
        moments = reward.moments() if isinstance(reward, Drawn) else (float(reward), 0.0)
        if terminated or truncated:
            state.variables()
            return Outcome(-1, *moments, bool(terminated), bool(truncated))
        return Outcome(self._number(observation, is_reset=action is None), *moments)

    def _number(self, observation: Any, is_reset: bool) -> int:
        """The number of the state that the environment is in; a new one gets the next."""
        self.state.check_clocks(is_reset)
        variables = self.state.variables()
        key = self.state.key(variables), self.state.by_value(observation)
        number = self.index.setdefault(key, len(self.index))
        if number == len(self.saved):
            if number >= self.max_states:
                raise Limit(f"more than {self.max_states:,} states; {self._growing()}")
            self.saved.append(self.state.save(variables))
            self.observations.append(copy.deepcopy(observation))
        return number

    def _linear(self, outcome: Outcome, saved: bytes, action: Any) -> Outcome:
        """The outcome of a run that made a float of a continuous number.

        Only the reward may depend on it, and linearly: then its mean and variance are known.
        """
        script, number = self.state.script, self.state.script.floats[0]
        plain, choices = Drawn(script, list(number.known)), [choice for choice, _ in script.trace]
        x, y = np.array([plain.at(level) for level in LEVELS]), []
        for script.level in LEVELS:
            script.begin(choices, len(choices), {})
            other = self._step(saved, action)
            y.append(other.reward)
            if other._replace(reward=outcome.reward) != outcome or len(script.floats) > 1:
                number.now()
        script.level = 0.5
        slope = (y[-1] - y[0]) / (x[-1] - x[0])
        if not np.allclose(y, y[0] + slope * (x - x[0]), rtol=1e-9, atol=1e-9):
            number.now()
        mean, variance = plain.linear(slope, y[0] - slope * x[0]).moments()
        return outcome._replace(reward=mean, variance=variance)

    def _tick(self) -> None:
        """Watch the time, and now and then the constants."""
        self.runs += 1
        if self.runs % 8 == 0 and self.spent() > self.seconds:
            done = f"{len(self.saved):,} states found, {len(self.rows):,} of them done; "
            done = done * bool(self.rows) + self._growing()
            raise Limit(f"no end after {self.seconds:g} seconds: {done}")
        if self.runs & (self.runs - 1) == 0:
            self.state.check_constants()
        if self.progress is not None and self.runs % 256 == 0:
            self.progress(len(self.saved), len(self.rows))

    def _growing(self) -> str:
        """What there is most of: outcomes, or values of an attribute."""
        if not self.rows:
            what = "a step" if self.initial else "`reset`"
            hint = "" if self.initial else " (optimum --starts 0 1 2 takes three)"
            return f"{what} has more than {self.runs:,} outcomes{hint}"
        values = self._values(sample := self.saved[:: max(1, len(self.saved) // 500)])
        place = max(values, key=lambda place: len(values[place]), default=(0, "state"))
        many = f"`{(name := place[1])}` has {len(values[place])} values in {len(sample)} of them"
        return f"{many} (optimum --ignore {name} if it changes nothing)"

    def state_now(self, observation: Any, time: int) -> int | None:
        """The number in the model of the state that the environment is in; None if unknown."""
        try:
            variables = self.state.variables()
        except Refuted as refuted:
            raise Stop(f"`{refuted.args[0][1]}` is changed outside `step`") from None
        number = self.index.get((self.state.key(variables), self.state.by_value(observation)))
        if time == 0 and number is None:
            self.refuse_start(self.state.contents(variables))
        return None if number is None else min(time, self.times - 1) * len(self.rows) + number

    @property
    def horizon(self) -> int | None:
        """The steps of the longest episode, where the environment itself counts them."""
        return self.end + 1 if self.state.clocks and self.end < NEVER - 1 else None

    def _count_times(self) -> int:
        """At how many times the states of the model are told apart; 1 if time changes nothing."""
        for (_, usual), *later in (spans for row in self.rows for spans in row if spans):
            _, last = later[-1] if later else (0, usual)
            if self.horizon is not None and any(outcome.state >= 0 for outcome in last):
                raise Refuted(next(iter(self.state.clocks)))  # the limit is not that of all states
            if any(first < self.end or not _alike(usual, chances) for first, chances in later):
                if self.horizon is None:
                    raise Refuted(next(iter(self.state.clocks)))
                return self.end + 1
        return 1

    def _model(self) -> tuple[TransitionModel, Bools]:
        """The model, whose state at time t has the number t * states + state, and its mask."""
        n, self.times = len(self.rows), self._count_times()
        most = max(len(chances) for row in self.rows for spans in row for _, chances in spans)
        shape = self.times, n, len(self.actions), most
        if 5 * np.prod(shape, dtype=float) > MOST_ENTRIES:
            raise Limit(f"a model of {n:,} states at {self.times:,} times is too large")
        table = np.zeros((5, *shape))  # probability, reward, variance, end, next state
        table[0, ..., 0] = table[3] = 1.0  # of actions that are not allowed
        for (s, row), a in itertools.product(enumerate(self.rows), range(len(self.actions))):
            for first, chances in row[a]:
                parts = [(p, *o[1:3], o.state < 0, max(o.state, 0)) for o, p in chances.items()]
                table[:, first:, s, a] = 0.0
                table[:, first:, s, a, : len(parts)] = np.array(parts).T[:, None]
        table[0] /= table[0].sum(axis=3, keepdims=True)
        table[4] += n * np.minimum(np.arange(self.times) + 1, self.times - 1)[:, None, None, None]
        prob, reward, variance, ends, following = table.reshape(5, self.times * n, *shape[2:])
        initial = np.zeros(self.times * n)
        for outcome, p in self.initial.items():
            initial[outcome.state] = p / sum(self.initial.values())
        noise = variance if variance.any() else None
        model = TransitionModel(
            prob, following.astype(np.int64), reward, ends.astype(np.bool_), initial, noise
        )
        mask = [[bool(spans) for spans in row] for row in self.rows]
        return model, np.tile(mask, (self.times, 1))


def _alike(one: Chances, other: Chances) -> bool:
    """Whether both earn the same rewards and end as often, whatever else they do."""
    a, b = (sum(p * np.array([o.reward, o.terminated]) for o, p in x.items()) for x in (one, other))
    return bool(np.allclose(a, b, rtol=1e-12, atol=1e-12))
