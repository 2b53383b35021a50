"""Jobs of a queue that have ended are sent again, and others are left alone."""

import asyncio
from types import SimpleNamespace

import pytest

from experiments.cluster import schedulers
from experiments.cluster.schedulers import SECONDS_TO_RESTART, Jobs


class Queue:
    """Two jobs of dask-jobqueue, of one worker each or of two."""

    def __init__(self, suffixes):
        self.suffixes = suffixes
        self.worker_spec = {"job-1": {}, "job-10": {}}
        self.workers, self.closed, self._futures = {}, [], set()
        self.scheduler = SimpleNamespace(workers={})
        self.loop = SimpleNamespace(add_callback=lambda function, *args: function(*args))
        self.n_sent = 0

    def scale(self, jobs):
        assert jobs == 2
        for name in self.worker_spec.keys() - self.workers.keys():
            self.n_sent += 1
            self.workers[name] = SimpleNamespace(close=lambda name=name: self.close(name))

    async def close(self, name):
        self.closed.append(name)

    def arrive(self, job, port):
        for i, suffix in enumerate(self.suffixes):
            address = f"tls://{port}{i}"
            worker = SimpleNamespace(name=f"{job}{suffix}", address=address)
            self.scheduler.workers[address] = worker

    def lose(self, *addresses):
        for address in addresses:
            del self.scheduler.workers[address]


@pytest.fixture
def clock(monkeypatch):
    fake = SimpleNamespace(now=100.0)
    monkeypatch.setattr(schedulers, "time", SimpleNamespace(monotonic=lambda: fake.now))
    return fake


def test_a_job_whose_worker_has_retired_is_sent_again_at_once(clock):
    async def retire():
        queue = Queue(("",))
        jobs = Jobs(queue, 2)
        assert queue.n_sent == 2
        jobs.replace(())
        queue.arrive("job-1", 1)
        jobs.replace(())
        queue.lose("tls://10")
        jobs.replace({"tls://10"})
        await asyncio.gather(*queue._futures)
        # The other still waits in the queue, however long that takes, and so does the new one.
        clock.now += 10 * SECONDS_TO_RESTART
        jobs.replace({"tls://10"})
        return queue

    queue = asyncio.run(retire())
    assert (queue.closed, queue.n_sent) == (["job-1"], 3)


def test_where_it_is_lost_it_has_time_to_be_started_again(clock):
    async def lose():
        queue = Queue(("",))
        jobs = Jobs(queue, 2)
        for port in (1, 2):
            queue.arrive("job-10", port)
            jobs.replace(())
            queue.lose(f"tls://{port}0")
            clock.now += SECONDS_TO_RESTART
            jobs.replace(())
            assert queue.n_sent == 2
        clock.now += 1
        jobs.replace(())
        await asyncio.gather(*queue._futures)
        return queue

    queue = asyncio.run(lose())
    assert (queue.closed, queue.n_sent) == (["job-10"], 3)


def test_a_job_of_several_workers_ends_with_the_last_of_them(clock):
    async def retire():
        queue = Queue(("-0", "-1"))
        jobs = Jobs(queue, 2)
        queue.arrive("job-1", 1)
        queue.arrive("job-10", 2)
        jobs.replace(())
        queue.lose("tls://10")
        jobs.replace({"tls://10"})
        assert queue.n_sent == 2
        queue.lose("tls://11")
        jobs.replace({"tls://10", "tls://11"})
        await asyncio.gather(*queue._futures)
        return queue

    queue = asyncio.run(retire())
    assert (queue.closed, queue.n_sent) == (["job-1"], 3)
