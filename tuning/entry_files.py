"""Entries of hyperparameters as files, which say what they were tuned on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from pipeline.files import plain
from pipeline.settings.hyperparams import TUNED_ON, seeds_tuned_on
from tuning.tuning_spec import TuningSpec


def entry_text(tuning: TuningSpec, entry: Mapping[str, Any], lines: Sequence[str]) -> str:
    """A file with one entry, as `hyperparams/` has them.

    Args:
        tuning: what was asked for.
        entry: the hyperparameters.
        lines: what is said of them.
    """
    env_id = tuning.environment.env_id.partition(":")[2] or tuning.environment.env_id
    seeds = [{"first": each.start, "count": len(each)} for each in tuned_seeds(tuning)]
    said = {TUNED_ON: {env_id: seeds[0] if len(seeds) == 1 else seeds}}
    comment = "".join(f"# {line}\n" for line in lines)
    return f"{_yaml(said)}\n{comment}{_yaml({env_id: plain(entry)})}"


def tuned_seeds(tuning: TuningSpec) -> list[range]:
    """The seeds that settings of a search have seen: its own, and those of where it began."""
    agent = tuning.agent
    before = seeds_tuned_on(agent.algo, tuning.environment.env_id, agent.conf_file) or ()
    return _joined([*before, range(tuning.study.first_seed, tuning.study.seeds.stop)])


def _joined(ranges: Sequence[range]) -> list[range]:
    """The same seeds in as few ranges as can be, in their order."""
    joined: list[range] = []
    for each in sorted(ranges, key=lambda seeds: seeds.start):
        if joined and each.start <= joined[-1].stop:
            joined[-1] = range(joined[-1].start, max(joined[-1].stop, each.stop))
        elif each:
            joined.append(each)
    return joined


class _Dumper(yaml.SafeDumper):
    """Writes a setting a line; lists of plain values, and seeds, in one."""


def _list(dumper: yaml.SafeDumper, items: list[Any]) -> yaml.Node:
    are_plain = not any(isinstance(item, list | dict) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=are_plain)


def _mapping(dumper: yaml.SafeDumper, items: dict[str, Any]) -> yaml.Node:
    return dumper.represent_mapping(
        "tag:yaml.org,2002:map", items, flow_style=items.keys() == {"first", "count"}
    )


_Dumper.add_representer(list, _list)
_Dumper.add_representer(dict, _mapping)


def _yaml(data: Mapping[str, Any]) -> str:
    return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True))
