"""Bandits: each step pulls one arm, and no pull affects the rewards of later pulls."""

from envs.bandits.bandit import Bandit, StochasticBandit
from envs.bandits.clicks import BernoulliBandit, ClickBandit, SegmentBandit
from envs.bandits.gaussian import GaussianBandit
from envs.bandits.linear import LinearBandit
from envs.bandits.logged import LoggedData, ReplayBandit, log_uniformly, read_log

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
