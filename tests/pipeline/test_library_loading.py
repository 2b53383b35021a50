"""Libraries are imported without the garbage collector, which is back afterwards."""

import gc

import pytest

from pipeline.library_loading import loading_libraries


@pytest.fixture
def collector():
    before = gc.isenabled()
    yield
    (gc.enable if before else gc.disable)()


@pytest.mark.usefixtures("collector")
@pytest.mark.parametrize("was_on", [True, False])
def test_the_collector_is_as_it_was(was_on):
    (gc.enable if was_on else gc.disable)()
    with loading_libraries():
        assert not gc.isenabled()
    assert gc.isenabled() == was_on
