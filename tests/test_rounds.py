"""What the rows of a round say of episodes: first decisions, ends, team mates that departed, moves."""

import numpy as np
import pytest
import torch
from fakes import Record as R
from fakes import ScriptedEnv, behavior_spec
from masked import masked_gae

from mappo_unity.envs.slots import SlotTable
from mappo_unity.envs.transforms import transformed
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.errors import ConfigError
from mappo_unity.learning.carried import has_value
from mappo_unity.learning.networks.critics import seen_features
from mappo_unity.scenes import make_scene

END, CUT = "terminated", "interrupted"


def one(agent, **rest):
    return R(agent, group=1, **rest)


def two(agent, **rest):
    return R(agent, group=2, **rest)


def open_env(script, **options):
    return UnityEnv(lambda seed: ScriptedEnv(script), **options)


def play(env, rounds):
    """Return the rows of ``rounds`` rounds, as a collector would see them."""
    rows, td = [], env.reset()
    for _ in range(rounds):
        td = env.rand_action(td)
        row, td = env.step_and_maybe_reset(td)
        rows.append(row)
    return torch.stack(rows)


def read(rows, *key):
    """Return an entry of the policy "Fake", a list for every round with a value for every slot."""
    key = (key[0], "Fake", key[1]) if len(key) == 2 else ("Fake", *key)
    return rows[key].flatten(1).tolist()


# --- first decisions


def test_the_first_decision_of_every_episode_is_marked():
    env = open_env(
        [
            [R(0), R(1)],
            [R(0), R(1)],
            [R(0, ends=END), R(0), R(1)],
            [R(0)],  # 1 is not asked
            [R(1, ends=CUT), R(0)],
            [R(0), R(5)],  # 5 takes the slot of 1
            [R(0), R(5)],
        ]
    )
    rows = play(env, 6)
    assert read(rows, "is_init") == [
        [True, True],
        [False, False],
        [True, False],
        [False, False],
        [False, False],
        [False, True],
    ]
    assert read(rows, "next", "is_init")[:-1] == read(rows, "is_init")[1:]
    assert rows["Fake", "is_init"].shape == (6, 2, 1, 1)


def test_a_full_reset_and_a_return_before_the_team_ends_begin_anew():
    env = open_env([[one(0), one(1)], [one(0, ends=END), one(1)], [one(0), one(1)], [one(0), one(1)]])
    rows = play(env, 3)
    assert read(rows, "is_init") == [[True, True], [False, False], [True, False]]
    assert read(env.reset().unsqueeze(0), "is_init") == [[True, True]]


def test_both_sides_say_who_is_at_its_first_decision():
    names = ("Soccer?team=1", "Soccer?team=0")
    both = [R(0, behavior=names[0]), R(1, behavior=names[1])]
    script = [both, both, [R(1, ends=END, behavior=names[1]), *both]]
    env = transformed(UnityEnv(lambda seed: ScriptedEnv(script, dict.fromkeys(names, behavior_spec()))))
    rows = env.rollout(2, break_when_any_done=False)
    assert rows["Soccer", "is_init"].flatten(1).tolist() == [[True, True], [False, False]]
    assert rows["next", "Soccer", "is_init"].flatten(1).tolist() == [[False, False], [False, True]]


class Snapshots(ScriptedEnv):
    """A script that goes on from where a snapshot was taken."""

    def get_state(self):
        return {"at": self.at}

    def set_state(self, state):
        self.at = state["at"]


def test_a_snapshot_knows_first_decisions_and_an_older_one_still_loads():
    script = [[R(0), R(1)], [R(0, ends=END), R(0), R(1)], [R(0), R(1)]]
    env = UnityEnv(lambda seed: Snapshots(script))
    play(env, 1)
    state = env.get_state()
    for leave_out in ([], ["first"]):
        for name in leave_out:
            del state["behaviors"]["Fake?team=0"][name]
        other = UnityEnv(lambda seed: Snapshots(script))
        other.set_state(state)
        assert read(other.reset().unsqueeze(0), "is_init") == [[True, False]]


# --- what `next` says of an episode that ended


def cut_team(then):
    """A team of three that loses one member and is then cut off, beside a team of one."""
    return [
        [one(0, obs=1), one(1, obs=2), one(2, obs=3), two(9)],
        [one(0, obs=9, ends=END), one(1, obs=4), one(2, obs=5), two(9)],
        [one(1, obs=6, ends=CUT), one(2, obs=7, ends=CUT), *then, two(9)],
        [one(10), one(11), one(12), two(9)],
    ]


@pytest.mark.parametrize("then", [[], [one(10, obs=8), one(11, obs=8), one(12, obs=8)]])
def test_a_team_that_was_cut_off_is_seen_as_it_was(then):
    rows = play(open_env(cut_team(then)), 3)
    assert read(rows, "next", "present")[1] == [True, True, True, True, False, False]
    assert read(rows, "next", "departed")[1] == [True, False, False, False, False, False]
    assert read(rows, "next", "obs_0")[1][:3] == [0, 6, 7]
    assert read(rows, "next", "done")[1] == [True, True, True, False, False, False]
    # the root says who is there now
    assert read(rows, "present")[2][:3] == [bool(then)] * 3
    assert not then or read(rows, "obs_0")[2][:3] == [8, 8, 8]
    assert not rows["Fake", "departed"][2].any()

    inputs = (rows["next", "Fake", key][1, 0] for key in ("obs_0", "present", "departed"))
    features, seen = seen_features(lambda obs: obs, tuple(inputs))
    assert (features.flatten().tolist(), seen.flatten().tolist()) == ([0, 6, 7], [0, 1, 1])


def test_ends_in_two_results_of_one_round_are_both_seen():
    env = open_env(
        [
            [one(0), one(1), two(9)],
            [one(0, obs=5, ends=CUT)],
            [one(1, obs=6, ends=CUT), two(9)],
        ]
    )
    rows = play(env, 1)
    assert read(rows, "next", "present") == [[True, True, True, False]]
    assert read(rows, "next", "obs_0")[0][:2] == [5, 6]


def test_a_departed_member_that_begins_anew_ends_as_it_was():
    env = open_env(
        [
            [one(0, obs=1), one(1, obs=1)],
            [one(0, obs=9, ends=END), one(1, obs=2)],
            [one(0, obs=3), one(1, obs=3)],  # back in a later round: its slot saw zeros until now
            [one(0, obs=8, ends=END), one(0, obs=4), one(1, obs=4)],  # back at once
            [one(0), one(1)],
        ]
    )
    rows = play(env, 3)
    # its team earned on while it was away, so that the value of that goes on
    assert [row[0] for row in read(rows, "next", "terminated")] == [False, False, True]
    assert [row[0] for row in read(rows, "next", "truncated")] == [False, True, False]
    assert [row[0] for row in read(rows, "next", "obs_0")] == [0, 0, 8]
    assert [row[0] for row in read(rows, "next", "departed")] == [True, True, False]
    assert rows["next", "Fake", "present"].all()
    assert [row[0] for row in read(rows, "obs_0")] == [1, 0, 3]


def test_a_departed_flag_of_an_ended_slot_gives_it_no_value():
    batch = play(open_env(cut_team([one(10), one(11), one(12)])), 2)["Fake"]
    root = play(open_env(cut_team([one(10), one(11), one(12)])), 3)["Fake"][-1]
    following = play(open_env(cut_team([one(10), one(11), one(12)])), 2)["next", "Fake"]
    assert following["departed"][-1, 0, 0] and not root["departed"][0, 0]

    ended = (following["terminated"], following["truncated"])
    torch.manual_seed(0)
    reward, value, end_value = torch.randn(3, *following["done"].shape)
    results = [
        masked_gae(
            *(reward, value, end_value, final, has_value(batch), has_value(last), *ended),
            gamma=0.9,
            gae_lambda=0.8,
        )
        for last, final in ((following[-1], value[0]), (root, torch.where(ended[1][-1], 7.0, value[0])))
    ]
    # one with the flag and one without: the ended rows cut the recursion
    for one_way, other in zip(*results):
        assert torch.equal(one_way, other)
    assert results[0].known[:, 0].all()


@pytest.mark.parametrize("name", ["DungeonEscape", "SoccerTwos"])
def test_next_equals_the_following_root_where_no_episode_ended(name):
    torch.manual_seed(0)
    rows = play(UnityEnv(lambda seed: make_scene(name, seed=seed, num_areas=2)), 120)
    for behavior in rows["next"].keys():
        following = rows["next", behavior][:-1]
        same = ~following["done"].squeeze(-1)
        assert same.any()
        for key in (*("acting", "present", "departed", "is_init", "action_mask"), "obs_0"):
            assert torch.equal(following[key][same], rows[behavior][1:][key][same]), key


# --- departed members whose team is cut off


@pytest.mark.parametrize(
    ("last", "expected"),
    [((CUT, CUT), CUT), ((END, END), END), ((CUT, END), CUT)],
)
def test_departed_members_end_as_the_last_of_their_team(last, expected):
    env = open_env(
        [
            [one(0), one(1), one(2)],
            [one(0, ends=END), one(1), one(2)],
            [one(1, ends=last[0]), one(2, ends=last[1]), one(0, obs=3), one(1), one(2)],
        ]
    )
    rows = play(env, 2)
    assert read(rows, "next", "truncated") == [[False] * 3, [expected == CUT, *(end == CUT for end in last)]]
    assert read(rows, "next", "terminated") == [[False] * 3, [expected == END, *(end == END for end in last)]]
    assert read(rows, "next", "departed")[1] == [True, False, False]
    assert read(rows, "next", "obs_0")[1] == [0, 0, 0]
    # its own episode was a real end
    assert [episode.interrupted for episode in env.pop_episodes()["Fake?team=0"]] == [
        *(False, last[0] == CUT, last[1] == CUT)
    ]


def test_departed_members_go_on_while_one_of_their_team_is_left():
    env = open_env(
        [
            [one(0), one(1), one(2)],
            [one(0, ends=END), one(1), one(2)],
            [one(1, ends=CUT), one(2, group_reward=1)],
            [one(2, ends=CUT, group_reward=2), one(0)],
        ]
    )
    rows = play(env, 3)
    assert [row[0] for row in read(rows, "next", "truncated")] == [False, False, True]
    assert [row[0] for row in read(rows, "next", "departed")] == [True, True, True]
    assert not rows["next", "Fake", "terminated"].any()


# --- group rewards of departed members


def departed_earns(script, slot=0, **options):
    """Return what the slot of a departed member earns as group reward, round by round."""
    return [
        row[slot] for row in read(play(open_env(script, **options), len(script) - 1), "next", "group_reward")
    ]


def test_a_departed_member_earns_a_group_reward_once_though_mates_report_at_other_times():
    script = [
        [one(0), one(1), one(2)],
        [one(0, ends=END), one(2)],
        # the team gets 1: 2 ends and tells of it, 1 not yet
        [one(2, ends=END, group_reward=1), two(9)],
        # then it gets 0.5 more: 1 tells of both
        [one(1, group_reward=1.5)],
        [one(1, group_reward=0.25)],
    ]
    assert departed_earns(script, max_teams=2) == [0, 1, 0.5, 0.25]
    assert departed_earns(script, slot=2, max_teams=2) == [0, 1, 0.5, 0.25]
    assert departed_earns(script, slot=1, max_teams=2) == [0, 0, 1.5, 0.25]


def test_what_a_member_earned_before_it_departed_is_not_paid_again():
    script = [
        [one(0), one(1)],
        # the team gets 2, then -0.5: 0 tells of the first, and departs after the second
        [one(0, group_reward=2)],
        [one(0, group_reward=-0.5, ends=END), two(9)],
        # -3 more: 1 has been asked last at the start
        [one(1, group_reward=-1.5)],
        [one(1, group_reward=0), two(9)],
        [one(1, group_reward=-1, ends=END), two(9)],
    ]
    assert departed_earns(script, max_teams=2) == [2, -0.5, -3, 0, -1]


def test_staggered_mates_of_a_departed_member_that_earn_below_zero():
    script = [
        [one(0), one(1), one(2)],
        [one(0, ends=END, group_reward=1), one(1, group_reward=1), one(2, group_reward=1)],
        [one(1, group_reward=-2)],  # the team has -1
        [one(2, group_reward=-1.5)],  # and -0.5
        [one(1, group_reward=0.5)],  # known already
        [one(1, group_reward=0.25), one(2, group_reward=0.25)],
        [one(1), one(2)],
    ]
    assert departed_earns(script) == [1, -2, 0.5, 0, 0.25, 0]


def test_a_member_that_joins_knows_nothing_of_what_was_before():
    script = [
        [one(0), one(1), one(2)],
        [one(0, ends=END, group_reward=4), one(1, group_reward=4), one(2, ends=CUT, group_reward=4)],
        [one(7), one(1, group_reward=1)],  # takes the place of 2; comes first, with nothing earned yet
        [one(7, group_reward=2)],
        [one(1, group_reward=2.5), one(7, group_reward=0.5)],
    ]
    assert departed_earns(script) == [4, 1, 2, 0.5]


def test_a_team_s_next_episode_begins_with_nothing():
    once = [
        [one(0), one(1)],
        [one(0, ends=END), one(1)],
        [one(1, ends=END, group_reward=5), one(0), one(1)],
        [one(0, ends=END), two(9)],
        [one(1, group_reward=0.5)],
    ]
    assert departed_earns(once, max_teams=2) == [0, 5, 0, 0.5]


def test_a_snapshot_knows_what_was_paid_and_an_older_one_begins_with_nothing():
    script = [
        [one(0), one(1), two(9)],
        [one(0, ends=END, group_reward=2), two(9)],
        [one(1, group_reward=2.5)],
    ]
    env = UnityEnv(lambda seed: Snapshots(script))
    play(env, 1)
    state = env.get_state()
    assert state["behaviors"]["Fake?team=0"]["team_total"].tolist() == [2, 0]
    for leave_out, expected in (([], 0.5), (["team_total", "seen"], 2.5)):
        for name in leave_out:
            del state["behaviors"]["Fake?team=0"][name]
        other = UnityEnv(lambda seed: Snapshots(script))
        other.set_state(state)
        assert read(play(other, 1), "next", "group_reward") == [[expected, 2.5, 0, 0]]


def test_without_death_masking_no_snapshot_holds_group_rewards():
    env = open_env([[one(0), one(1)]], death_masking=False)
    assert "seen" not in env.behaviors["Fake?team=0"].get_state()


# --- agents that change their group


def returns(env):
    """Return of every finished episode its agent, its two returns, its length and whether it was cut off."""
    return [tuple(episode)[:5] for episode in env.pop_episodes()["Fake?team=0"]]


def test_an_agent_that_changes_its_group_goes_on_in_its_new_team():
    env = open_env(
        [
            [one(0, obs=1), one(1, obs=2), two(2, obs=3)],
            # the same agents in the same order
            [two(0, obs=5, reward=2, group_reward=3), one(1, obs=6), two(2, obs=7)],
            [two(0, obs=8, reward=1), one(1), two(2)],
            [two(0, obs=9, reward=0.5, ends=CUT), one(1), two(2, ends=CUT)],
        ]
    )
    rows = play(env, 3)
    assert read(rows, "acting")[:2] == [[True, True, True, False], [False, True, True, True]]
    assert read(rows, "next", "truncated")[:2] == [[True, False, False, False], [False] * 4]
    assert not rows["next", "Fake", "terminated"].any()
    assert read(rows, "next", "reward") == [[2, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0.5]]
    assert read(rows, "next", "group_reward")[0] == [3, 0, 0, 0]

    # the old row ends with what the agent saw as it moved
    assert read(rows, "next", "obs_0")[0] == [5, 6, 7, 5]
    assert read(rows, "next", "obs_0")[1][1:] == [0, 0, 8]
    assert read(rows, "next", "present")[0] == [True, True, True, True]
    assert read(rows, "present")[1] == [False, True, True, True]
    assert read(rows, "is_init")[1:] == [[False, False, False, True], [False] * 4]

    # it is one episode all the same
    assert returns(env) == [(0, 3.5, 3.0, 3, True), (2, 0.0, 0.0, 3, True)]


def test_full_teams_exchange_members():
    env = open_env(
        [
            [one(0, obs=1), one(1, obs=2), two(2, obs=3), two(3, obs=4)],
            [two(0, obs=5, reward=1), one(1, obs=6), one(2, obs=7, reward=2), two(3, obs=8)],
            [one(2, reward=3, ends=END), two(0, reward=4, ends=END), one(1, ends=END), two(3, ends=END)],
            [R(9, group=3)],
        ]
    )
    rows = play(env, 2)
    assert read(rows, "next", "truncated")[0] == [True, False, True, False]
    assert read(rows, "next", "obs_0")[0] == [5, 6, 7, 8]
    assert read(rows, "next", "reward") == [[1, 0, 2, 0], [3, 0, 4, 0]]
    assert read(rows, "obs_0")[1] == [7, 6, 5, 8]
    assert read(rows, "is_init")[1] == [True, False, True, False]
    assert rows["Fake", "present"].all()
    assert [row[:4] for row in returns(env)[:2]] == [(2, 5.0, 0.0, 2), (0, 5.0, 0.0, 2)]


def test_an_agent_that_ended_and_begins_in_another_group_is_placed_anew():
    env = open_env(
        [
            [one(0, obs=1), one(1), two(2)],
            [one(1), two(2), one(0, obs=9, reward=1, ends=CUT), two(0, obs=2, reward=7)],
            [two(0, obs=3), one(1), two(2)],
        ]
    )
    rows = play(env, 2)
    assert read(rows, "next", "truncated") == [[True, False, False, False], [False] * 4]
    assert read(rows, "next", "obs_0")[0][0] == 9
    assert read(rows, "next", "reward") == [[1, 0, 0, 0], [0] * 4]
    assert read(rows, "is_init")[1] == [False, False, False, True]
    assert returns(env) == [(0, 1.0, 0.0, 1, True)]


def test_a_departed_member_s_slot_earns_on_though_its_agent_begins_in_another_group():
    env = open_env(
        [
            [one(0), one(1), two(2)],
            [one(0, ends=END), two(0), one(1), two(2)],
            [two(0, group_reward=9), one(1, group_reward=1), two(2, group_reward=9)],
            [two(0), one(1, group_reward=2, ends=END), two(2)],
        ]
    )
    rows = play(env, 3)
    assert [row[0] for row in read(rows, "next", "group_reward")] == [0, 1, 2]
    assert [row[0] for row in read(rows, "next", "terminated")] == [False, False, True]
    assert [row[3] for row in read(rows, "is_init")] == [False, True, False]


def test_departed_members_end_with_the_last_of_their_team_that_moves_away():
    env = open_env(
        [
            [one(0), one(1), two(2)],
            [one(0, ends=END), one(1), two(2)],
            [two(1, group_reward=2), two(2, group_reward=1)],
            [two(2, ends=END, group_reward=4), R(9, group=3)],
            [two(1, group_reward=4.5)],
        ],
        max_teams=3,
    )
    rows = play(env, 4)
    assert [row[:2] for row in read(rows, "next", "truncated")] == [
        [False] * 2,
        [True] * 2,
        [False] * 2,
        [False] * 2,
    ]
    assert [row[0] for row in read(rows, "next", "group_reward")] == [0, 2, 0, 0]
    assert read(rows, "next", "departed")[1] == [True, *[False] * 5]
    assert not rows["Fake", "present"][2, 0].any()
    # in its new team it has seen what this has earned when it came, 1, and nothing of its old team's
    assert [row[2] for row in read(rows, "next", "group_reward")] == [0, 1, 4, 0.5]


def test_an_agent_that_leaves_its_group_is_alone_and_more_than_there_is_room_for_is_an_error():
    script = [[one(0), one(1)], [one(0), R(1)], [one(0), R(1, reward=1)]]
    rows = play(open_env(script, max_teams=2), 2)
    assert read(rows, "acting")[1] == [True, False, True, False]
    assert read(rows, "next", "reward")[1] == [0, 0, 1, 0]
    with pytest.raises(ConfigError, match=r"agent 1.*env\.max_teams=2"):
        play(open_env(script), 2)
    with pytest.raises(ConfigError, match=r"agent 1.*group 1.*env\.max_team_size=2"):
        play(open_env([[R(0), R(1)], [one(0), one(1)]]), 1)


def test_a_snapshot_after_a_move_goes_on():
    script = [
        [one(0), one(1), two(2)],
        [two(0, reward=1), one(1), two(2)],
        [one(1), two(2), two(0, reward=2, ends=END)],
        [one(5), two(0), one(1), two(2)],
    ]
    env = UnityEnv(lambda seed: Snapshots(script))
    play(env, 1)
    other = UnityEnv(lambda seed: Snapshots(script))
    other.set_state(env.get_state())
    rows = play(other, 2)
    assert read(rows, "next", "reward") == [[0, 0, 0, 2], [0] * 4]
    assert returns(other) == [(0, 3.0, 0.0, 2, False)]
    assert read(other.root().unsqueeze(0), "acting") == [[True] * 4]


def test_a_new_agent_leaves_the_slot_of_one_that_begins_anew_with_it():
    table = SlotTable("Fake", num_teams=1, team_size=2)
    groups = np.ones(2, np.int32)
    table.assign(np.array([0, 1], np.int32), groups)
    table.ended[:] = True
    assert table.assign(np.array([7, 0], np.int32), groups).tolist() == [1, 0]
