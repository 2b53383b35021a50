"""Numbers drawn ahead are those that would have been drawn one by one."""

import copy

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from agents.compiled.random_streams import UniformStreams

CAPACITY = 7
N = 3

# How many numbers are asked for, and of those how many each generator uses up.
ROUND = st.integers(0, CAPACITY).flatmap(
    lambda need: st.tuples(st.just(need), st.lists(st.integers(0, need), min_size=N, max_size=N))
)
# Rounds between two times that the generators are given back.
SESSIONS = st.lists(st.lists(ROUND, max_size=6), max_size=4)


def generators(seed=0):
    return [np.random.default_rng([seed, i]) for i in range(N)]


def states(made):
    return [generator.bit_generator.state for generator in made]


@given(SESSIONS, st.integers(0, 2**32))
def test_any_pattern_of_use(sessions, seed):
    ahead, direct = generators(seed), generators(seed)
    streams = UniformStreams(ahead, CAPACITY)
    for session in sessions:
        for need, use in session:
            streams.refill(need)
            for row, start, used, generator in zip(
                streams.uniforms, streams.used, use, direct, strict=True
            ):
                expected = [generator.random() for _ in range(used)]
                assert row[start : start + used].tolist() == expected
            streams.used += use
        streams.give_back()
        assert states(ahead) == states(direct)
        # Whoever has the generators meanwhile may draw from them in any way.
        for generator in (*ahead, *direct):
            generator.standard_normal()


@given(st.integers(0, CAPACITY), st.integers(0, 5))
def test_giving_back_restores_the_generator(used, half_words):
    (generator, *others) = generators()
    # Numbers of 32 bits come in pairs: after an odd number of them one waits to be used.
    generator.integers(0, 1000, half_words, dtype=np.uint32)
    expected = copy.deepcopy(generator)
    expected.random(used)
    streams = UniformStreams([generator, *others], CAPACITY)
    streams.refill(CAPACITY)
    streams.used += used
    streams.give_back()
    assert states([generator]) == states([expected])
    # Once more changes nothing.
    streams.give_back()
    assert states([generator]) == states([expected])
