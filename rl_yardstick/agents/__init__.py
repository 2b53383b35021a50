"""The agents, each a Stable-Baselines3 algorithm, and the registry of their names.

Importing this package loads neither torch nor Stable-Baselines3, so that names can be listed and
spaces compared quickly.
"""

from rl_yardstick.agents.registry import (
    ALGORITHMS,
    AlgorithmEntry,
    fitting_algorithms,
    load_algorithm,
    name_of,
    register,
)

__all__ = ["ALGORITHMS", "AlgorithmEntry", "fitting_algorithms", "load_algorithm"]
__all__ += ["name_of", "register"]
