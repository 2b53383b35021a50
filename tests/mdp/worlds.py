"""Small models for tests: from tables, of environments, random ones."""

import gymnasium as gym
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from envs.known_models import observations_of_states, transition_model
from mdp import TransitionModel
from mdp.memoryless import observation_groups


def model_of(env_id, **kwargs):
    return transition_model(gym.make(f"envs:{env_id}", **kwargs))


def deterministic(next_state, reward, ends, start=0):
    """A model without chance, from tables of shape (S, A)."""
    following = np.asarray(next_state)[:, :, None]
    return TransitionModel(
        prob=np.ones(following.shape),
        next_state=following,
        reward=np.asarray(reward, float)[:, :, None],
        terminated=np.asarray(ends, bool)[:, :, None],
        initial=np.eye(len(following))[start],
    )


@st.composite
def distributions(draw, shape):
    """Small fractions along the last axis, zeros among them."""
    weight = draw(hnp.arrays(np.int64, shape, elements=st.integers(0, 3)))
    weight[..., 0] += weight.sum(axis=-1) == 0
    return weight / weight.sum(axis=-1, keepdims=True)


@st.composite
def models(draw, states=5, actions=3, outcomes=3, always_ends=False):
    """Models of up to the given sizes, with small whole numbers as rewards.

    With ``always_ends``, the first outcome of each state and action ends the episode.
    """
    n_states, n_actions = draw(st.integers(1, states)), draw(st.integers(1, actions))
    shape = (n_states, n_actions, draw(st.integers(1, outcomes)))
    prob = draw(distributions(shape))
    terminated = draw(hnp.arrays(np.bool_, shape))
    if always_ends:
        prob = 0.75 * prob + 0.25 * (np.arange(shape[2]) == 0)
        terminated[..., 0] = True
    return TransitionModel(
        prob=prob,
        next_state=draw(hnp.arrays(np.int64, shape, elements=st.integers(0, n_states - 1))),
        reward=draw(hnp.arrays(np.int64, shape, elements=st.integers(-3, 3))),
        terminated=terminated,
        initial=draw(distributions((n_states,))),
    )


def continuing(model):
    """By action, the probabilities of going from state to state without an end, shape (A, S, S)."""
    found = np.zeros((model.n_actions, model.n_states, model.n_states))
    states, actions, outcomes = np.nonzero((model.prob > 0) & ~model.terminated)
    at = states, actions, outcomes
    np.add.at(found, (actions, states, model.next_state[at]), model.prob[at])
    return found


def random_world(seed, n_states=4, n_actions=2, n_groups=2):
    """A random world with terminations, and what is observed, which hides the state."""
    rng = np.random.default_rng(seed)
    shape = (n_states, n_actions, 2)
    model = TransitionModel(
        prob=rng.dirichlet(np.ones(2), shape[:2]),
        next_state=rng.integers(n_states, size=shape),
        reward=rng.integers(-3, 4, size=shape).astype(float),
        terminated=rng.random(shape) < 0.15,
        initial=rng.dirichlet(np.ones(n_states)),
    )
    return model, rng.permutation(np.arange(n_states) % n_groups)


def hidden_of(env_id, **kwargs):
    """The model of an environment, and the groups of states that look alike."""
    env = gym.make(f"envs:{env_id}", **kwargs)
    model = transition_model(env)
    return model, observation_groups(observations_of_states(env), model.reachable)
