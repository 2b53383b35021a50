"""Gymnasium environments whose optimum is known exactly; importing the package registers them.

Gymnasium imports it by itself for an id such as ``rl_yardstick.envs:Warehouse-v0``.
"""

from rl_yardstick.envs.registration import register_environments

register_environments()
