"""Teams with a network for each member: an agent stays the member that it is while others die and come."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fakes import Record, ScriptedEnv

from mappo_unity.config.schema import ModelConfig
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import make_actor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.policies.episodes import play
from mappo_unity.policies.layouts import describe_spec
from mappo_unity.policies.members import MemberTable
from mappo_unity.policies.policy import ActorPolicy

FAKE, SIZE = "Fake?team=0", 3


def policy_of_three(env: ScriptedEnv) -> ActorPolicy:
    """Return a policy whose member 0, 1, 2 does -2/3, 0, 2/3 whatever it sees."""
    actor = make_actor(
        ObsLayout(1), ActionLayout(1, ()), SIZE, ModelConfig(hidden=[4], share_parameters=False)
    )
    with torch.no_grad():
        for member, net in enumerate(actor.module[0].module.nets):
            net.net[-1].weight.zero_()
            net.net[-1].bias.fill_(2.0 * (member - 1))
    return ActorPolicy({"Fake": describe_spec(env.specs[FAKE], SIZE)}, {"Fake": actor}, True, "the policy")


def team(*agents: int, group: int = 1) -> list[Record]:
    return [Record(agent, group=group) for agent in agents]


def ends(*agents: int, group: int = 1) -> list[Record]:
    return [Record(agent, group=group, ends="terminated") for agent in agents]


def members_played(script: list[list[Record]], episodes: int) -> list[list[int]]:
    """Play a script; return the members whose networks chose the actions, result by result."""
    env = ScriptedEnv(script)
    play(env, policy_of_three(env), episodes)
    return [np.rint(1.5 * actions[:, 0] + 1).astype(int).tolist() for _, actions, _ in env.actions]


def test_the_others_keep_their_networks_when_the_first_member_dies() -> None:
    script = [team(7, 8, 9), [*ends(7), *team(8, 9)], team(9, 8), [*ends(8, 9)]]
    assert members_played(script, 3) == [[0, 1, 2], [1, 2], [2, 1]]


def test_members_that_request_decisions_at_different_times_keep_their_networks() -> None:
    script = [team(7, 8, 9), team(8), team(9, 7), ends(7, 8, 9)]
    assert members_played(script, 3) == [[0, 1, 2], [1], [2, 0]]


def test_the_next_episode_has_all_members_again_under_old_or_new_ids() -> None:
    script = [
        [*team(7, 8, 9), *team(4, 5, 6, group=2)],
        [*ends(7), *team(8, 9), *team(4, 5, 6, group=2)],
        [*ends(8, 9), *team(17, 18, 19), *ends(4, 5, 6, group=2), *team(6, 5, 4, group=2)],
        [*ends(17, 18, 19), *ends(4, 5, 6, group=2)],
    ]
    assert members_played(script, 12) == [
        [0, 1, 2, 0, 1, 2],
        [1, 2, 0, 1, 2],
        [0, 1, 2, 2, 1, 0],
    ]


def test_a_newcomer_takes_the_place_of_one_that_has_ended() -> None:
    table = MemberTable(SIZE)

    def places(*agents: int) -> list[int]:
        return table.places(np.array(agents), np.ones(len(agents), int)).members.tolist()

    assert places(7, 8) == [0, 1]
    table.end([7])
    assert places(8, 9) == [1, 2]  # a place that nobody has held comes first
    assert places(8, 9, 10) == [1, 2, 0]

    # whoever plays may tell of no ends: then it is the one that has not asked for longest
    assert places(9, 10) == [2, 0]
    assert places(9, 11) == [2, 1]
    assert places(9, 11, 10) == [2, 1, 0]
    with pytest.raises(ConfigError, match="a team of 4 agents is larger than the policy's 3 members"):
        places(1, 2, 3, 4)


def test_agents_without_a_group_are_the_first_member_of_their_teams() -> None:
    found = MemberTable(SIZE).places(np.array([5, 6, 7, 8]), np.array([0, 3, 0, 3]))
    assert found.members.tolist() == [0, 0, 0, 1] and found.shape == (3, SIZE)
    assert len({(t, m) for t, m in zip(found.teams, found.members)}) == 4
