"""What happens at each pull of a training, of whatever agent, on a bandit."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback


class PullLog(BaseCallback):
    """Keeps each pull as the environments tell of it, in about 25 bytes.

    Where an environment does not know what its arms are worth, figures are nan and no arm counts as
    optimal.
    """

    def __init__(self) -> None:
        super().__init__()
        self._obs: Any = None
        self._columns: dict[str, array[Any]] = {
            "arms": array("h"),
            "rewards": array("f"),
            "expected_rewards": array("d"),
            "regrets": array("d"),
            "matched": array("b"),
            "contexts": array("i"),
        }

    def _on_training_start(self) -> None:
        self._obs = self.model._last_obs
        if not isinstance(self.training_env.observation_space, spaces.Discrete):
            self._columns.pop("contexts", None)

    def _on_step(self) -> bool:
        infos, columns = self.locals["infos"], self._columns
        columns["arms"].extend(np.ravel(self.locals["actions"]).tolist())
        columns["rewards"].extend(self.locals["rewards"].tolist())
        columns["expected_rewards"].extend(i.get("expected_reward", np.nan) for i in infos)
        columns["regrets"].extend(info.get("regret", np.nan) for info in infos)
        columns["matched"].extend(info.get("matched", True) for info in infos)
        if "contexts" in columns:
            columns["contexts"].extend(np.ravel(self._obs).tolist())
        self._obs = self.locals["new_obs"]
        return True

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All pulls so far.

        Returns:
            ``arms`` (int16), ``rewards`` (float32), ``expected_rewards`` and ``regrets`` (float64),
            ``optimal`` and ``matched`` (bool: whether a log held the arm; true where there is no
            log), and, where contexts are numbers, ``contexts`` (int32), each of shape
            (n_envs, pulls).
        """
        n_envs = self.training_env.num_envs
        # Ctrl-C may come when some columns have the newest pull and others not yet.
        n_pulls = min(map(len, self._columns.values())) // n_envs
        arrays: dict[str, NDArray[Any]] = {
            name: np.array(column[: n_pulls * n_envs]).reshape(n_pulls, n_envs).T
            for name, column in self._columns.items()
        }
        arrays["matched"] = arrays["matched"].astype(np.bool_)
        arrays["optimal"] = arrays["regrets"] == 0.0
        return arrays
