"""Which agents there are: names, classes, and the spaces that they take."""

from __future__ import annotations

from agents.algorithm_entries import AlgorithmEntry

DISCRETE = ("Discrete",)
LINEAR_INPUTS = ("Box", "Discrete")
NETWORK_INPUTS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary", "Dict")
POLICY_GRADIENT_OUTPUTS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")
CONTINUOUS = ("Box",)
TABLE_ENGINES = ("auto", "compiled", "interpreted")
LIBRARY_ENGINES = ("library", "compiled", "auto")
NETWORK_ENGINES = ("auto", "compiled", "library")
VECTOR_INPUTS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")


def _tabular(entry_point: str, summary: str) -> AlgorithmEntry:
    entry_point = f"agents.tabular.{entry_point}"
    return AlgorithmEntry(entry_point, summary, DISCRETE, DISCRETE, engines=TABLE_ENGINES)


def _tiled(entry_point: str, summary: str) -> AlgorithmEntry:
    entry_point = f"agents.linear.{entry_point}"
    return AlgorithmEntry(entry_point, summary, LINEAR_INPUTS, DISCRETE, engines=TABLE_ENGINES)


def _deep(
    entry_point: str,
    summary: str,
    actions: tuple[str, ...] = DISCRETE,
    engines: tuple[str, ...] = LIBRARY_ENGINES[:1],
) -> AlgorithmEntry:
    return AlgorithmEntry(entry_point, summary, NETWORK_INPUTS, actions, engines=engines)


def _contrib(
    entry_point: str,
    summary: str,
    actions: tuple[str, ...],
    observations: tuple[str, ...] = NETWORK_INPUTS,
    *,
    needs_masks: bool = False,
) -> AlgorithmEntry:
    return AlgorithmEntry(
        entry_point,
        f"{summary} (sb3-contrib)",
        observations,
        actions,
        needs_masks=needs_masks,
        package="sb3_contrib",
        extra="contrib",
        engines=LIBRARY_ENGINES[:1],
    )


def _bandit(entry_point: str, summary: str) -> AlgorithmEntry:
    entry_point = f"agents.bandits.{entry_point}"
    return AlgorithmEntry(entry_point, summary, DISCRETE, DISCRETE, for_bandits=True)


def _linear(name: str, summary: str) -> AlgorithmEntry:
    return AlgorithmEntry(
        f"agents.bandits.linear_bandits:{name}", summary, LINEAR_INPUTS, DISCRETE, for_bandits=True
    )


def _mabwiser(name: str, summary: str, observations: tuple[str, ...] = DISCRETE) -> AlgorithmEntry:
    return AlgorithmEntry(
        f"agents.mabwiser.mabwiser_agents:{name}",
        f"{summary} (MABWiser)",
        observations,
        DISCRETE,
        for_bandits=True,
        package="mabwiser",
        extra="bandits",
    )


ALGORITHMS: dict[str, AlgorithmEntry] = {
    "qlearning": _tabular("q_learning:QLearning", "Q-learning on a table"),
    "sarsa": _tabular("sarsa:SARSA", "SARSA on a table"),
    "expected_sarsa": _tabular("expected_sarsa:ExpectedSARSA", "Expected SARSA on a table"),
    "double_qlearning": _tabular(
        "double_q_learning:DoubleQLearning", "double Q-learning on two tables"
    ),
    "n_step_sarsa": _tabular("episodes.n_step_sarsa:NStepSARSA", "n-step SARSA on a table"),
    "n_step_tree_backup": _tabular(
        "episodes.tree_backup:NStepTreeBackup", "n-step tree backup on a table"
    ),
    "sarsa_lambda": _tabular(
        "episodes.sarsa_lambda:SARSALambda", "SARSA(lambda): traces on a table"
    ),
    "q_lambda": _tabular("episodes.q_lambda:QLambda", "Watkins's Q(lambda): traces on a table"),
    "monte_carlo": _tabular("episodes.monte_carlo:MonteCarlo", "on-policy Monte Carlo on a table"),
    "off_policy_monte_carlo": _tabular(
        "episodes.off_policy_monte_carlo:OffPolicyMonteCarlo", "off-policy Monte Carlo on a table"
    ),
    "dyna_q": _tabular("models.dyna_q:DynaQ", "Q-learning that plans on a learnt model"),
    "dyna_q_plus": _tabular(
        "models.dyna_q_plus:DynaQPlus", "Dyna-Q with a bonus for actions not tried for long"
    ),
    "prioritized_sweeping": _tabular(
        "models.prioritized_sweeping:PrioritizedSweeping", "planning first where values change most"
    ),
    "r_max": _tabular("models.r_max:RMax", "planning that assumes the best of everything unknown"),
    "qlearning_ucb": _tabular(
        "q_learning_ucb:QLearningUCB", "Q-learning with upper confidence bounds"
    ),
    "semi_gradient_sarsa": _tiled(
        "semi_gradient_sarsa:SemiGradientSARSA", "SARSA on tile coding (or a table)"
    ),
    "semi_gradient_q": _tiled(
        "semi_gradient_q:SemiGradientQ", "Q-learning on tile coding (or a table)"
    ),
    "actor_critic": _tiled("actor_critic:ActorCritic", "one-step actor-critic on tiles or a table"),
    "reinforce": _tiled(
        "reinforce:Reinforce", "REINFORCE on tiles or a table, with or without a baseline"
    ),
    "dqn": _deep("agents.dqn:DQN", "deep Q-network (Stable-Baselines3)", engines=LIBRARY_ENGINES),
    "double_dqn": _deep(
        "agents.deep:DoubleDQN", "DQN with van Hasselt's target", engines=NETWORK_ENGINES
    ),
    "deep_qlearning": _deep(
        "agents.deep:DeepQLearning",
        "DQN of 2013: squared loss, no target network",
        engines=NETWORK_ENGINES,
    ),
    "ppo": _deep(
        "agents.policy_gradients:PPO",
        "proximal policy optimisation (Stable-Baselines3)",
        POLICY_GRADIENT_OUTPUTS,
        LIBRARY_ENGINES,
    ),
    "a2c": _deep(
        "agents.policy_gradients:A2C",
        "advantage actor-critic (Stable-Baselines3)",
        POLICY_GRADIENT_OUTPUTS,
        LIBRARY_ENGINES,
    ),
    "sac": _deep("stable_baselines3:SAC", "soft actor-critic (Stable-Baselines3)", CONTINUOUS),
    "td3": _deep(
        "stable_baselines3:TD3", "twin delayed policy gradient (Stable-Baselines3)", CONTINUOUS
    ),
    "ddpg": _deep(
        "stable_baselines3:DDPG",
        "deep deterministic policy gradient (Stable-Baselines3)",
        CONTINUOUS,
    ),
    "qrdqn": _contrib("sb3_contrib:QRDQN", "quantile-regression DQN", DISCRETE),
    "tqc": _contrib("sb3_contrib:TQC", "truncated quantile critics", CONTINUOUS),
    "crossq": _contrib(
        "sb3_contrib:CrossQ", "SAC without target networks", CONTINUOUS, VECTOR_INPUTS
    ),
    "trpo": _contrib(
        "sb3_contrib:TRPO", "trust-region policy optimisation", POLICY_GRADIENT_OUTPUTS
    ),
    "ars": _contrib(
        "agents.random_search:ARS",
        "augmented random search",
        (*CONTINUOUS, *DISCRETE),
        VECTOR_INPUTS,
    ),
    "ppo_lstm": _contrib(
        "sb3_contrib:RecurrentPPO",
        "PPO with a memory",
        # As it is in sb3-contrib 2.9, which fails on the other spaces.
        ("Box", "Discrete", "MultiDiscrete"),
        ("Box", "Discrete", "MultiBinary", "Dict"),
    ),
    "ppo_mask": _contrib(
        "sb3_contrib:MaskablePPO",
        "PPO that is told which actions are valid",
        ("Discrete", "MultiDiscrete", "MultiBinary"),
        needs_masks=True,
    ),
    "value_iteration": AlgorithmEntry(
        "agents.planning:ValueIteration",
        "planning: greedy in the optimal values",
        DISCRETE,
        DISCRETE,
    ),
    "policy_iteration": AlgorithmEntry(
        "agents.planning:PolicyIteration",
        "planning: policies evaluated and improved in turn",
        DISCRETE,
        DISCRETE,
    ),
    "optimal": AlgorithmEntry(
        "agents.planning:Optimal",
        "planning: the optimum under the time limit",
        DISCRETE,
        DISCRETE,
    ),
    "random": AlgorithmEntry(
        "agents.reference:RandomAgent",
        "uniformly random actions",
        NETWORK_INPUTS,
        POLICY_GRADIENT_OUTPUTS,
    ),
    "angle": AlgorithmEntry(
        "agents.reference:AngleAgent",
        "CartPole: push to where the pole leans",
        ("Box",),
        DISCRETE,
        observation_shape=(4,),
    ),
    "epsilon_greedy": _bandit("value_bandits:EpsilonGreedy", "bandit: epsilon-greedy"),
    "boltzmann": _bandit("value_bandits:Boltzmann", "bandit: softmax of the estimates"),
    "ucb": _bandit("ucb:UCB", "bandit: upper confidence bounds"),
    "kl_ucb": _bandit("kl_ucb:KLUCB", "bandit: upper bounds by Kullback-Leibler divergence"),
    "gradient_bandit": _bandit("gradient_bandit:GradientBandit", "bandit: gradient on preferences"),
    "exp3": _bandit("exp3:Exp3", "bandit: exponential weights against an adversary"),
    "thompson": _bandit("thompson:Thompson", "bandit: Thompson sampling"),
    "linucb": _linear("LinUCB", "contextual bandit: linear upper confidence bounds"),
    "lin_thompson": _linear("LinThompson", "contextual bandit: linear Thompson sampling"),
    "lin_epsilon_greedy": _linear("LinEpsilonGreedy", "contextual bandit: linear, epsilon-greedy"),
    "mabwiser_epsilon_greedy": _mabwiser("MABWiserEpsilonGreedy", "bandit: epsilon-greedy"),
    "mabwiser_ucb1": _mabwiser("MABWiserUCB1", "bandit: UCB1"),
    "mabwiser_thompson": _mabwiser("MABWiserThompson", "bandit: Thompson sampling"),
    "mabwiser_linucb": _mabwiser("MABWiserLinUCB", "contextual bandit: LinUCB", LINEAR_INPUTS),
}
