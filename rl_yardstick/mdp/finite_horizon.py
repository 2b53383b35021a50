"""The optimal policy under a time limit, which depends on the number of steps left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.machine_code.compiling import compiled
from rl_yardstick.mdp.planning import TIE_TOLERANCE, action_value
from rl_yardstick.mdp.transition_model import Bools, Dynamics, Floats, Ints, TransitionModel

# The smallest unsigned integers that hold the actions.
Actions = NDArray[np.unsignedinteger]


@dataclass(frozen=True, eq=False)
class FiniteHorizonPlan:
    """An optimal policy under a time limit."""

    #: The optimal expected (discounted) sum of rewards from each state at step 0, shape (S,); zero
    #: for states that cannot be reached.
    values: Floats
    #: The greedy action, the first among ties within 1e-12 of the best value, with 1, 2, ... steps
    #: left: shape (m, S). With more than m steps left, the last row applies.
    actions_left: Actions
    horizon: int  #: the number of steps after which the episode is cut off
    start_value: float  #: the mean of ``values`` over the starting states

    @property
    def policy(self) -> Actions:
        """The actions at each step, shape (horizon, S), in order of time."""
        left = np.minimum(np.arange(self.horizon, 0, -1), len(self.actions_left))
        rows: Actions = self.actions_left[left - 1]
        return rows


def finite_horizon_optimum(
    model: TransitionModel, horizon: int, discount: float = 1.0, mask: Bools | None = None
) -> FiniteHorizonPlan:
    """Plan backwards from the time limit.

    Stops once a step changes no value in its last bit: further steps would change none either.
    Sutton and Barto, Reinforcement Learning, 2nd edition, chapter 4; Puterman, Markov
    Decision Processes, 1994, section 4.5.

    Arguments and errors are those of `mdp.planning.value_iteration`, and ``horizon``, the time
    limit in steps, at least 1.
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, it must be at least 1")
    if not 0 <= discount <= 1:
        raise ValueError(f"discount is {discount}, it must lie between 0 and 1")
    states = np.flatnonzero(model.reachable)
    allowed = model.allowed_actions(mask)
    values = np.zeros(model.n_states)
    rows: list[Actions] = []
    for _ in range(horizon):
        earlier = np.zeros(model.n_states)
        actions = np.zeros(model.n_states, np.min_scalar_type(model.n_actions - 1))
        back_up(model.dynamics, allowed, float(discount), states, values, earlier, actions)
        rows.append(actions)
        if np.array_equal(earlier, values):
            break
        values = earlier
    return FiniteHorizonPlan(values, np.array(rows), horizon, float(model.initial @ values))


@compiled
def back_up(
    model: Dynamics,
    allowed: Bools,
    discount: float,
    states: Ints,
    values: Floats,
    earlier: Floats,
    actions: Actions,
) -> None:
    """Values one step earlier, and the actions to take there, into ``earlier`` and ``actions``."""
    prob = model[0]
    action_values = np.empty(prob.shape[1])
    for state in states:
        # A loop: NumPy's maximum takes longer to compile than all of this.
        best = -np.inf
        for action in range(prob.shape[1]):
            if not allowed[state, action]:
                action_values[action] = -np.inf
                continue
            value = action_value(model, state, action, values, discount)
            action_values[action] = value
            best = max(best, value)
        tied = best - TIE_TOLERANCE * max(1.0, abs(best))
        action = 0
        while action_values[action] < tied:
            action += 1
        earlier[state] = best
        actions[state] = action
