"""All that may stand in files of models, put together from what is known of each library."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from safe_files import gymnasium_spaces, library_objects, library_schedules, numpy_objects
from safe_files.library_classes import library_classes
from safe_files.limits import Budget
from safe_files.pickle_trees import read_tree
from safe_files.rebuilding import Admitted, Maker, rebuild


@cache
def admitted() -> Admitted:
    """What may stand in any of the files."""
    makers = {
        **numpy_objects.MAKERS,
        **gymnasium_spaces.MAKERS,
        **library_objects.MAKERS,
        **library_schedules.MAKERS,
    }
    return Admitted(makers, {**numpy_objects.CLASSES, **library_classes()})


def read_pickle(
    pickled: bytes,
    classes: Mapping[str, type] | None = None,
    makers: Mapping[str, Maker] | None = None,
    budget: Budget | None = None,
) -> Any:
    """What a pickle stands for, made without unpickling.

    Args:
        pickled: the pickle.
        classes: further classes that it may name, by their full names.
        makers: what makes further objects in it, likewise.
        budget: pays for it; None for that of a file that is this pickle.

    Raises:
        UnsafeFileError: if it is damaged, or holds what may not stand in it.
    """
    budget = budget or Budget(len(pickled))
    usual = admitted()
    here = Admitted({**usual.makers, **(makers or {})}, {**usual.classes, **(classes or {})})
    return rebuild(read_tree(pickled, budget), here, budget)
