"""Training returns, summed up by blocks of episodes."""

from __future__ import annotations

import pandas as pd

from experiments.results import StudyResults
from experiments.run_files import read_episodes


def episodes_table(results: StudyResults, width: int) -> pd.DataFrame:
    """Training returns by blocks of episodes, over all seeds of an agent.

    Args:
        results: the runs.
        width: episodes in a block.

    Returns:
        Columns agent, environment, episode (the last of the block), average, minimum, maximum.
    """
    rows = []
    for planned in results.finished:
        returns = read_episodes(planned.run).returns
        block = pd.Series(range(len(returns))) // width
        rows.append(
            pd.DataFrame(
                {
                    "agent": planned.agent,
                    "environment": planned.environment,
                    "episode": (block + 1) * width,
                    "return": returns,
                }
            )
        )
    if not rows:
        return pd.DataFrame(columns=["agent", "environment", "episode"])
    grouped = pd.concat(rows).groupby(["environment", "agent", "episode"], sort=False)["return"]
    return grouped.agg(average="mean", minimum="min", maximum="max").reset_index()
