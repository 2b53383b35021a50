"""What is drawn through a handle is what the generator itself would draw next."""

import numpy as np
import pytest

from agents.compiled.generators import handles_of, next_uniform, skip_uniform
from machine_code.compiling import kernel

KINDS = (np.random.PCG64, np.random.PCG64DXSM, np.random.MT19937, np.random.Philox)


@kernel
def draw(handles, skipped, numbers):
    for i in range(len(numbers)):
        for _ in range(skipped):
            skip_uniform(handles[0])
        numbers[i] = next_uniform(handles[0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("skipped", [0, 3])
def test_numbers_are_the_generators_own(kind, skipped):
    rng, own = (np.random.Generator(kind(7)) for _ in range(2))
    for generator in (rng, own):
        generator.integers(9, dtype=np.uint32)  # leaves half of a number behind in some of them
    numbers = np.empty(1000)
    draw(handles_of([rng]), skipped, numbers)
    assert numbers.tolist() == own.random((1000, skipped + 1))[:, -1].tolist()
    assert str(rng.bit_generator.state) == str(own.bit_generator.state)
    assert rng.integers(9, dtype=np.uint32) == own.integers(9, dtype=np.uint32)


def test_only_pcg64_is_stepped_where_it_lies():
    handles = handles_of([np.random.Generator(kind(7)) for kind in KINDS])
    assert handles["pcg64"].astype(bool).tolist() == [True, False, False, False]
