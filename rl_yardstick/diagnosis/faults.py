"""What algorithms claim to be, the faults that an audit can name with sources, and findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

# The next value in a target: that of the best action; that of the learner's next action; or the
# state's under the learner's policy, for learners without action values.
Target = Literal["maximises", "follows", "states"]
KINDS: Mapping[str, Target] = {
    "q_learning": "maximises",
    "off_policy_monte_carlo": "maximises",
    "sarsa": "follows",
    "expected_sarsa": "follows",
    "actor_critic": "states",
    "policy_gradient": "states",
}
BOOK = "Sutton and Barto (2nd edition)"


class Fault(NamedTuple):
    """A way in which an algorithm is wrong."""

    sentence: str
    source: str  # the publication that says what is right


# The most telling first: a fault that explains others comes before them.
FAULTS: Mapping[str, Fault] = {
    "shared-buffer": Fault(
        "Stored data changes later: it is no copy, or another agent writes into it too.",
        "Mnih et al. (2015), algorithm 1: the transition is stored as it was",
    ),
    "bootstraps-at-terminal": Fault(
        "The target bootstraps from what is observed at the end of a terminated episode.",
        f"{BOOK}, section 6.1: V(terminal) = 0",
    ),
    "reset-observation": Fault(
        "After a truncation, the target bootstraps from the next episode's first observation.",
        "Pardo et al. (2018), Time limits in reinforcement learning, section 3",
    ),
    "no-bootstrap-at-truncation": Fault(
        "A truncated episode is treated as terminated: its target does not bootstrap.",
        "Pardo et al. (2018), Time limits in reinforcement learning, section 3",
    ),
    "target-never-copied": Fault(
        "The target network is never updated: values do not propagate.",
        "Mnih et al. (2015), algorithm 1: every C steps reset Q^ = Q",
    ),
    "discount-twice": Fault(
        "The discount is applied twice: the next value counts gamma squared.",
        f"{BOOK}, section 3.3, equation 3.9",
    ),
    "discount-missing": Fault(
        "The next value is not discounted.", f"{BOOK}, section 3.3, equation 3.9"
    ),
    "importance-ratio": Fault(
        "The importance sampling ratio of the two policies' probabilities is wrong.",
        f"{BOOK}, section 5.5; Schulman et al. (2017), equations 6 and 7, for PPO",
    ),
    "follows-instead-of-maximises": Fault(
        "The target follows the policy's next action, where it should take the best one.",
        f"{BOOK}, section 6.5, equation 6.8",
    ),
    "maximises-instead-of-follows": Fault(
        "The target takes the best next action, where it should follow the policy.",
        f"{BOOK}, section 6.4, equation 6.7",
    ),
    "stale-buffer": Fault(
        "It still learns from old steps that should have been replaced.",
        "Mnih et al. (2015), algorithm 1: memory of capacity N; for rollouts Schulman et al. "
        "(2017), algorithm 1",
    ),
    "n-step-return": Fault(
        "A target of several steps is not the discounted sum of its rewards and the last value.",
        f"{BOOK}, section 7.1, equation 7.1",
    ),
    "traces": Fault(
        "Credit does not decay by gamma times lambda with each step back, or is not cut off.",
        f"{BOOK}, section 12.2, equation 12.5, and 12.10; Schulman et al. (2016), equation 16, for "
        "the advantages of rollouts",
    ),
    "advantage-sign": Fault(
        "The policy makes actions less likely that were better than expected.",
        f"{BOOK}, section 13.5, equation 13.14",
    ),
    "entropy-sign": Fault(
        "The entropy term lowers the policy's entropy, where it should raise it.",
        "Mnih et al. (2016), section 4; Haarnoja et al. (2018), equation 1",
    ),
    "target-always-copied": Fault(
        "The target network copies the learning one at once, whatever its settings say.",
        "Mnih et al. (2015), algorithm 1; Lillicrap et al. (2016), algorithm 1",
    ),
    "schedule-backwards": Fault(
        "A schedule runs from its end to its beginning.",
        f"{BOOK}, section 2.5; Stable-Baselines3: progress_remaining goes from 1 to 0",
    ),
    "schedule-constant": Fault(
        "A schedule has no effect: its value stays the same.",
        f"{BOOK}, section 2.5; Stable-Baselines3: progress_remaining goes from 1 to 0",
    ),
    "explores-in-evaluation": Fault(
        "It still explores where it is asked for its best action.",
        "Machado et al. (2018), section 4; Stable-Baselines3: predict(deterministic=True)",
    ),
    "not-reproducible": Fault(
        "The same seed gives different results.",
        "Stable-Baselines3: BaseAlgorithm.set_random_seed; Henderson et al. (2018)",
    ),
    "global-generator": Fault(
        "It draws from global generators that its seed does not set.",
        "Stable-Baselines3: BaseAlgorithm.set_random_seed; NumPy enhancement proposal 19",
    ),
    "zip-forgets-tables": Fault(
        "The saved file lacks the learnt values.", "Stable-Baselines3: BaseAlgorithm.save"
    ),
    "zip-forgets-optimizer": Fault(
        "The optimizer's state is not in the saved file: training continues differently.",
        "Stable-Baselines3: BaseAlgorithm._get_torch_save_params",
    ),
    "zip-forgets-schedules": Fault(
        "Schedules, or the progress along them, are not in the saved file.",
        "Stable-Baselines3: BaseAlgorithm.save",
    ),
}


State = Literal["ok", "fault", "unsaid", "skipped"]
UNEXPLAINED = "no fault known here explains it"


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    state: State
    text: str = ""  #: what was measured, or why nothing can be said
    fault: str = ""  #: a key of `FAULTS`
    right: str = ""  #: the correct result
    probe: str = ""  #: the name of the check


def checked(is_wrong: bool, text: str, fault: str, right: str) -> Finding:
    """The finding of a check with two outcomes."""
    return Finding("fault", text, fault, right) if is_wrong else Finding("ok", text)
