"""Bandits: each step pulls one arm, and no pull affects the rewards of later pulls."""

from rl_yardstick.envs.bandits.bandit import Bandit, StochasticBandit
from rl_yardstick.envs.bandits.clicks import BernoulliBandit, ClickBandit, SegmentBandit
from rl_yardstick.envs.bandits.gaussian import GaussianBandit
from rl_yardstick.envs.bandits.linear import LinearBandit
from rl_yardstick.envs.bandits.logged import LoggedData, ReplayBandit, log_uniformly, read_log

__all__ = [
    "Bandit",
    "BernoulliBandit",
    "ClickBandit",
    "GaussianBandit",
    "LinearBandit",
    "LoggedData",
    "ReplayBandit",
    "SegmentBandit",
    "StochasticBandit",
    "log_uniformly",
    "read_log",
]
