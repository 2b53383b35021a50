"""Passes the episodes and log records of a compiled block to Monitor and the logger."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from stable_baselines3.common.logger import DISABLED, KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.monitor import Monitor

from rl_yardstick.agents.common.algorithm import is_read
from rl_yardstick.machine_code.compiling import inlined, kernel
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints

# Rows of Monitor's files as text; compiled code writes them if returns are integers.

MOST_DIGITS = 19
# Python writes larger integers with an exponent.
LARGEST = 1e15
COMMA, MINUS, POINT, ZERO = b",-.0"

Bytes = NDArray[np.uint8]


def whole_rows(returns: Floats, lengths: Ints, end: str) -> str | None:
    """A row ``<return>.0,<length>,<end>`` for each episode; None if a return is no integer."""
    room = np.empty(len(returns) * (2 * MOST_DIGITS + len(end) + 5), dtype=np.uint8)
    n_bytes = _write_all(returns, lengths, np.frombuffer(end.encode("ascii"), np.uint8), room)
    return None if n_bytes < 0 else room[:n_bytes].tobytes().decode("ascii")


@kernel
def _write_all(returns: Floats, lengths: Ints, end: Bytes, room: Bytes) -> int:
    """Fill the buffer, and return the number of bytes; -1 if a return is no integer."""
    place = 0
    for i in range(len(returns)):
        if not abs(returns[i]) < LARGEST or returns[i] != np.floor(returns[i]):
            return -1
        whole = int(returns[i])
        if whole < 0:
            room[place] = MINUS
            place += 1
        place = _write_number(abs(whole), room, place)
        room[place] = POINT
        room[place + 1] = ZERO
        room[place + 2] = COMMA
        place = _write_number(lengths[i], room, place + 3)
        room[place] = COMMA
        place += 1
        for k in range(len(end)):
            room[place + k] = end[k]
        place += len(end)
    return place


@inlined
def _write_number(number: int, room: Bytes, place: int) -> int:
    """Write a non-negative number, and return the position after it."""
    n_digits, power = 1, 10
    while number >= power:
        n_digits += 1
        power *= 10
    for k in range(n_digits - 1, -1, -1):
        room[place + k] = ZERO + number % 10
        number //= 10
    return place + n_digits


# Data of many episodes at once, for Monitor and the logger.

DECIMALS = 6
MOST_BEGINNINGS = 10_000


@dataclass(frozen=True)
class Episodes:
    """Episodes that ended in a block, in order of time."""

    envs: Ints  # which environment each ran in, shape (n_episodes,)
    steps: Ints  # at which step of the block it ended, shape (n_episodes,)
    returns: Floats  # sum of its rewards, shape (n_episodes,)
    lengths: Ints  # number of its steps, shape (n_episodes,)
    successes: Bools  # whether it was a success, shape (n_episodes,)

    @classmethod
    def of(cls, log: NDArray[np.void]) -> Episodes:
        """The episodes of records of type `EPISODE`, shape (n_episodes,)."""
        return cls(log["env"], log["step"], log["episode_return"], log["length"], log["success"])

    def rounded_returns(self) -> Floats:
        """Returns as Monitor reports them, shape (n_episodes,)."""
        if (self.returns == np.rint(self.returns)).all():
            return self.returns
        return np.array([_rounded(total) for total in self.returns.tolist()])

    def infos(self, chosen: slice, times: list[float]) -> list[dict[str, Any]]:
        """What Monitor would have put into ``info["episode"]`` for some of the episodes."""
        return [
            {"r": _rounded(total), "l": length, "t": times[env]}
            for env, total, length in zip(
                self.envs[chosen].tolist(),
                self.returns[chosen].tolist(),
                self.lengths[chosen].tolist(),
                strict=True,
            )
        ]


def record_in_monitors(
    monitors: list[Monitor | None], episodes: Episodes, n_steps: int
) -> list[float]:
    """Record a block of episodes in the Monitors, as each does at the end of an episode.

    Returns the time at the end of the block, which all get, in seconds since each was made.
    """
    times = []
    for i, monitor in enumerate(monitors):
        if monitor is None:
            times.append(0.0)
            continue
        monitor.total_steps += n_steps
        elapsed = time.time() - monitor.t_start
        times.append(round(elapsed, DECIMALS))
        chosen = slice(None) if len(monitors) == 1 else episodes.envs == i
        returns, lengths = episodes.returns[chosen], episodes.lengths[chosen]
        monitor.episode_returns += returns.tolist()
        monitor.episode_lengths += lengths.tolist()
        monitor.episode_times += [elapsed] * len(returns)
        if monitor.results_writer is not None and len(returns):
            _write_rows(monitor.results_writer.file_handler, returns, lengths, times[i])
    return times


def _write_rows(file: Any, returns: Floats, lengths: Ints, seconds: float) -> None:
    """Append rows as csv.DictWriter would."""
    end = f"{seconds}\r\n"
    text = whole_rows(np.ascontiguousarray(returns), np.ascontiguousarray(lengths), end)
    if text is None:
        # A complex number as key, because its look-up is faster than that of a pair.
        rows = (returns + 1j * lengths).tolist()
        text = end.join(map(_beginnings.__getitem__, rows)) + end
    file.write(text)
    file.flush()


class _Beginnings(dict[complex, str]):
    """Caches the beginning of rows: formatting is slow, and equal episodes are common.

    The key is the return of an episode, with its length as the imaginary part.
    """

    def __missing__(self, key: complex) -> str:
        if len(self) >= MOST_BEGINNINGS:
            self.clear()
        self[key] = beginning = f"{_rounded(key.real)},{int(key.imag)},"
        return beginning


_beginnings = _Beginnings()


@lru_cache(maxsize=10_000)
def _rounded(episode_return: float) -> float:
    return round(episode_return, DECIMALS)


# Log records that are due within a block of compiled steps, written at its end.
#
# A log of every 100 episodes is due some ten thousand times a second. The compiled loop stores the
# inputs of each record, and Python computes all records of a block at once. We append to
# TensorBoard's file once per block, because its own writer opens the file for each number.
#
# Format of the file: TensorFlow's `tfrecord`, each record an `Event` of TensorBoard with one value,
# as `SummaryWriter.add_scalar` writes it; checksums are CRC-32C (RFC 3720), masked.

# Numbers in memory at once while windows are averaged.
_AT_ONCE = 1_000_000

# Longer tags would need length fields of more than one byte.
_LONGEST_TAG = 100
_FRAME = 16  # bytes: the length and two checksums
_MOST_BYTES = _FRAME + 32 + _LONGEST_TAG

Row = tuple[dict[str, Any], dict[str, Any]]


def keeps_records(agent: Any, log_interval: int | None) -> bool:
    """Whether log records can wait for the end of a block.

    They cannot if code of others decides what is recorded, or when.
    """
    logger = agent.logger
    return (
        log_interval is not None
        and log_interval >= 1
        and is_read(logger)
        and logger.level != DISABLED
        and type(logger).dump is Logger.dump
        and not any(hasattr(Logger, name) for name in vars(logger))
        and agent.logs_by_records
        and all(
            getattr(type(agent), name).__module__.startswith("rl_yardstick.agents.")
            for name in ("_record_training", "dump_logs")
        )
    )


class Statistics:
    """The episodes before a block over which the log averages."""

    def __init__(self, agent: Any) -> None:
        self.size = int(agent._stats_window_size)
        self.returns = [info["r"] for info in agent.ep_info_buffer]
        self.lengths = [info["l"] for info in agent.ep_info_buffer]
        self.successes = list(agent.ep_success_buffer)

    def columns(self, episodes: Episodes, counts: Ints) -> dict[str, list[float]]:
        """The means after ``counts`` of the block's episodes, each of shape (n,)."""
        means = {
            "rollout/ep_rew_mean": (self.returns, episodes.rounded_returns()),
            "rollout/ep_len_mean": (self.lengths, episodes.lengths),
            "rollout/success_rate": (self.successes, episodes.successes),
        }
        return {
            name: window_means(np.concatenate([before, new]), len(before) + counts, self.size)
            for name, (before, new) in means.items()
        }


def window_means(values: Floats, ends: Ints, size: int) -> list[float]:
    """Means of the ``size`` numbers before each end, or of all if there are fewer.

    Each sum has the same rounding as a separate NumPy sum.
    """
    means = np.empty(len(ends))
    short = ends < size
    means[short] = [np.mean(values[:end]) for end in ends[short]]
    (full,) = np.nonzero(~short)
    n_parts = len(full) * size // _AT_ONCE + 1
    for part in np.array_split(full, n_parts) if len(full) else []:
        windows = sliding_window_view(values, size)[ends[part] - size]
        means[part] = np.ascontiguousarray(windows).mean(axis=1)
    return means.tolist()


def write_records(agent: Any, columns: Mapping[str, Any], times: Ints) -> None:
    """Write the records of a block to the logger's outputs.

    The agent's own `dump_logs` says which keys a record has: once with the values that callbacks
    have recorded since the last record, and once without.
    """
    steps = columns["time/total_timesteps"]
    begin = 0
    for end, (values, excluded) in zip((1, len(steps)), _kinds(agent, len(steps)), strict=False):
        part = slice(begin, end)
        table = {
            key: columns[key][part] if key in columns else [value] * (end - begin)
            for key, value in values.items()
        }
        for output in agent.logger.output_formats:
            if isinstance(output, KVWriter):
                _write_table(output, table, excluded, steps[part], times[part])
        begin = end


def _kinds(agent: Any, n_records: int) -> list[Row]:
    """The keys of the first record, and of all others."""
    logger, kept = agent.logger, _Kept()
    outputs, logger.output_formats = logger.output_formats, [kept]
    try:
        for _ in range(min(n_records, 2)):
            agent.dump_logs()
    finally:
        logger.output_formats = outputs
    return kept.rows


class _Kept(KVWriter):
    """An output that stores the written rows."""

    def __init__(self) -> None:
        self.rows: list[Row] = []

    def write(self, key_values: Any, key_excluded: Any, step: int = 0) -> None:
        self.rows.append((dict(key_values), dict(key_excluded)))


def _write_table(
    output: KVWriter,
    table: Mapping[str, Sequence[Any]],
    excluded: dict[str, Any],
    steps: Sequence[int],
    times: Ints,
) -> None:
    if type(output) is TensorBoardOutputFormat and _append(output, table, excluded, steps, times):
        return
    for step, *row in zip(steps, *table.values(), strict=True):
        output.write(dict(zip(table, row, strict=True)), excluded, step)


def _append(
    output: TensorBoardOutputFormat,
    table: Mapping[str, Sequence[Any]],
    excluded: dict[str, Any],
    steps: Sequence[int],
    times: Ints,
) -> bool:
    """Append the numbers to TensorBoard's file; False if this way is not possible."""
    keys = [key for key in sorted(table) if "tensorboard" not in (excluded[key] or ())]
    writer: Any = output.writer
    events: Any = getattr(writer._get_file_writer(), "event_writer", None)
    file = getattr(events, "_general_file_writer", None)
    are_numbers = all(isinstance(table[key][0], int | float | np.number) for key in keys)
    if file is None or not are_numbers or max(map(len, keys), default=0) > _LONGEST_TAG:
        return False
    with np.errstate(over="ignore"):
        numbers = np.array([table[key] for key in keys], dtype=np.float64).astype("<f4")
    events.flush()
    file.write(event_bytes(keys, numbers, np.asarray(steps), times / 1e9))
    events.flush()
    return True


def event_bytes(tags: Sequence[str], numbers: NDArray[Any], steps: Ints, times: Floats) -> bytes:
    """Bytes of an event file, with one event for each number."""
    encoded = [tag.encode() for tag in tags]
    tag_bytes = np.frombuffer(b"".join(encoded), np.uint8)
    ends = np.cumsum([len(tag) for tag in encoded])
    as_bytes = np.ascontiguousarray(numbers.T.astype("<f4")).view(np.uint8)
    room = np.empty(len(tags) * len(steps) * _MOST_BYTES, np.uint8)
    times_in_bytes = times.astype("<f8").view(np.uint8).reshape(-1, 8)
    n_bytes = _write_events(
        tag_bytes, ends, as_bytes.reshape(len(steps), -1), steps, times_in_bytes, _checksums(), room
    )
    return room[:n_bytes].tobytes()


def _checksums() -> NDArray[np.uint32]:
    """CRC-32C of each byte."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(0x82F63B78), table >> 1)
    return table.astype(np.uint32)


@kernel
def _write_events(
    tags: Bytes,
    ends: Ints,
    numbers: Bytes,
    steps: Ints,
    times: Bytes,
    checksums: Any,
    room: Bytes,
) -> int:
    """Fill the buffer, and return the number of bytes."""
    place = 0
    for row in range(len(steps)):
        begin = 0
        for column in range(len(ends)):
            end = ends[column]
            data = place + 12
            at = _write_event(tags, begin, end, numbers, row, column, steps[row], times, room, data)
            length = at - data
            for k in range(8):
                room[place + k] = (length >> (8 * k)) & 0xFF
            _write_checksum(checksums, room, place, place + 8)
            _write_checksum(checksums, room, data, at)
            place, begin = at + 4, end
    return place


@inlined
def _write_event(
    tags: Bytes,
    begin: int,
    end: int,
    numbers: Bytes,
    row: int,
    column: int,
    step: int,
    times: Bytes,
    room: Bytes,
    place: int,
) -> int:
    """Write the event of one number, and return the position after it."""
    room[place] = 0x09  # wall_time
    for k in range(8):
        room[place + 1 + k] = times[row, k]
    place += 9
    if step > 0:
        room[place] = 0x10  # step
        place += 1
        while step > 0x7F:
            room[place] = (step & 0x7F) | 0x80
            step >>= 7
            place += 1
        room[place] = step
        place += 1
    n = end - begin
    room[place], room[place + 1] = 0x2A, n + 9  # summary
    room[place + 2], room[place + 3] = 0x0A, n + 7  # value
    room[place + 4], room[place + 5] = 0x0A, n  # tag
    place += 6
    for k in range(n):
        room[place + k] = tags[begin + k]
    place += n
    room[place] = 0x15  # simple_value
    for k in range(4):
        room[place + 1 + k] = numbers[row, 4 * column + k]
    return place + 5


@inlined
def _write_checksum(checksums: Any, room: Bytes, begin: int, end: int) -> None:
    """Write the masked checksum of some bytes after them."""
    crc = 0xFFFFFFFF
    for k in range(begin, end):
        crc = (crc >> 8) ^ int(checksums[(crc ^ room[k]) & 0xFF])
    crc ^= 0xFFFFFFFF
    masked = (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF
    for k in range(4):
        room[end + k] = (masked >> (8 * k)) & 0xFF


def time_columns(agent: Any, steps: Ints, times: Ints) -> dict[str, list[int]]:
    """The log's entries on time, at these numbers of steps of the training."""
    elapsed = np.maximum((times - agent.start_time) / 1e9, sys.float_info.epsilon)
    speed = (steps - agent._num_timesteps_at_start) / elapsed
    return {
        "time/fps": speed.astype(np.int64).tolist(),
        "time/time_elapsed": elapsed.astype(np.int64).tolist(),
        "time/total_timesteps": steps.tolist(),
    }
