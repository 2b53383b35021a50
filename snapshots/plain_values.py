"""Values that never change, and are made again from a few words: paths, patterns, dates, dtypes."""

from __future__ import annotations

import datetime
import decimal
import logging
import pathlib
import re
import types
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th


@dataclass(frozen=True)
class PlainKind:
    """A kind of such values.

    Attributes:
        types: its classes.
        words: what a value is made from.
        make: the value that is made from it.
    """

    types: type | tuple[type, ...]
    words: Callable[[Any], list[Any]]
    make: Callable[..., Any]


PLAIN_KINDS: dict[str, PlainKind] = {
    "path": PlainKind(
        pathlib.PurePath,
        lambda path: [type(path).__name__, str(path)],
        lambda kind, text: getattr(pathlib, kind)(text),
    ),
    "pattern": PlainKind(re.Pattern, lambda found: [found.pattern, found.flags], re.compile),
    "dtype": PlainKind(
        np.dtype,
        lambda dtype: [np.lib.format.dtype_to_descr(dtype)],
        np.lib.format.descr_to_dtype,
    ),
    "seeds": PlainKind(
        np.random.SeedSequence,
        lambda seeds: [seeds.state],
        lambda state: np.random.SeedSequence(**state),
    ),
    "torch dtype": PlainKind(
        th.dtype, lambda dtype: [str(dtype).partition(".")[2]], lambda name: getattr(th, name)
    ),
    "device": PlainKind(th.device, lambda device: [str(device)], th.device),
    "size": PlainKind(th.Size, lambda size: [list(size)], th.Size),
    "slice": PlainKind(slice, lambda cut: [cut.start, cut.stop, cut.step], slice),
    "moment": PlainKind(
        datetime.datetime,
        lambda moment: [moment.isoformat(), repr(moment.tzinfo)],
        lambda text, _: datetime.datetime.fromisoformat(text),
    ),
    "date": PlainKind(datetime.date, lambda date: [date.isoformat()], datetime.date.fromisoformat),
    "duration": PlainKind(
        datetime.timedelta,
        lambda span: [span.days, span.seconds, span.microseconds],
        datetime.timedelta,
    ),
    "ellipsis": PlainKind(types.EllipsisType, lambda _: [], types.EllipsisType),
    "logger": PlainKind(logging.Logger, lambda logger: [logger.name], logging.getLogger),
    "decimal": PlainKind(decimal.Decimal, lambda number: [str(number)], decimal.Decimal),
}
PLAIN_TYPES: tuple[Any, ...] = tuple(kind.types for kind in PLAIN_KINDS.values())


def plain_words(value: Any) -> tuple[str, list[Any]] | None:
    """The kind of a value and what it is made from; None where that makes another one.

    Args:
        value: one of `PLAIN_TYPES`.
    """
    name, kind = next((n, k) for n, k in PLAIN_KINDS.items() if isinstance(value, k.types))
    words = kind.words(value)
    try:
        made = kind.make(*words)
    except (TypeError, ValueError, AttributeError):  # of a class of the user's, say
        return None
    is_same = type(made) is type(value) and kind.words(made) == words
    return (name, words) if is_same else None
