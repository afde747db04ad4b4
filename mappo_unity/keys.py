"""TensorDict keys and the legend of dimensions, in one place.

Legend (shape suffixes of tensors everywhere in the package):

    E  environment copies        T  rounds (one round = one call of ``UnityEnv.step``)
    S  sides of one policy name  G  teams of a side
    A  agents of a team          O  features of the observation
    K  discrete branches         C  continuous actions
    V  reward streams, each with a value of its own

A policy name ("3DBall", "SoccerTwos") is the first key; below it stand the entries named here.
An entry of a batch has shape ``[T, G, A, ...]`` for a policy with one side and ``[T, S, G, A, ...]``
for a policy with several.
"""

import re

OBS = "observation"  # float32 [..., A, O]: vector sensors, concatenated in the order of the specs
SENSOR = "obs_{}"  # [..., A, *sensor shape]: sensor i before concatenation; float32, uint8 of a `ByteImage`
ACTION = "action"  # see learning.networks.distributions.ActionLayout
LOG_PROB = "action_log_prob"  # float32 [..., A]
LOG_PROBS = "action_log_probs"  # float32 [..., A, C + K]: of each component, where ppo.ratio=component
MASK = "action_mask"  # bool [..., A, sum of branches]: True = allowed (Unity's sense, turned round)
ACTING = "acting"  # bool [..., A, 1]: the agent requested a decision in this round
MEMORY = "memory"  # float32 [..., A, M]: the actor's state under which the agent acts
MEMORY_AFTER = "memory_after"  # float32 [..., A, M]: the actor's state after that decision
TRACES = "traces"  # float32 [..., A, n]: what the critic remembers, see learning.networks.traces
PLAYER = "player"  # int64 [..., A, 1]: who plays the agent, `LEARNER` or the number of an opponent
PRESENT = "present"  # bool [..., A, 1]: an agent holds the slot (or held it and departed)
DEPARTED = "departed"  # bool [..., A, 1]: the agent ended for good while its team plays on
FIRST = "is_init"  # bool [..., A, 1]: the decision requested is the first of its agent's episode
REWARD = "reward"  # float32 [..., A, 1]: individual reward that arrived in this round
GROUP_REWARD = "group_reward"  # float32 [..., A, 1]: reward of the agent's team, likewise
DONE = "done"  # bool [..., A, 1]: terminated or truncated
TERMINATED = "terminated"  # bool [..., A, 1]: a real end
TRUNCATED = "truncated"  # bool [..., A, 1]: a time limit ("interrupted" in ML-Agents)
FINAL = "final"  # of what followed a batch: entries [..., A] behind its last round, as of an end in it
CUT_OFF = "cut_off"  # team rows [n, A] with an episode that was cut off (or ended): entries as they were
CUT_OFF_AT = "cut_off_at"  # int64 [n]: which team rows of the batch these are, from its end: -1 is the last
VALUE = "state_value"  # float32 [..., A, V]: in the critic's (normalised) space
ADVANTAGE = "advantage"  # float32 [..., A, 1]
VALUE_TARGET = "value_target"  # float32 [..., A, V]: in the critic's (normalised) space

LEARNER = -1
"""The `PLAYER` of agents that the policy which learns plays; others act, but not in the learner's sense."""


def policy_name(behavior_name: str) -> str:
    """Return the policy of a behavior: ``"SoccerTwos?team=1"`` -> ``"SoccerTwos"``."""
    return behavior_name.split("?", 1)[0]


def team_id(behavior_name: str) -> int:
    """Return the side of a behavior: ``"SoccerTwos?team=1"`` -> 1; 0 where none is given."""
    _, _, query = behavior_name.partition("?team=")
    return int(query) if query else 0


def file_stem(policy: str) -> str:
    """Return how files of a policy name are called: its own name, with ``_`` for what one may not hold."""
    return re.sub(r"[^\w.-]", "_", policy)
