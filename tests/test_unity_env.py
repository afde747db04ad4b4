"""The adapter: rounds, slots, ends, resets, masks, states."""

import numpy as np
import pytest
import torch
from fakes import Record as R
from fakes import ScriptedEnv, behavior_spec
from mlagents_envs.base_env import ActionSpec
from torchrl.envs.utils import check_env_specs

from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.errors import ConfigError
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.rules import EnvironmentDataError

END, CUT = "terminated", "interrupted"


def open_env(script, **options):
    base = ScriptedEnv(script, **({"specs": options.pop("specs")} if "specs" in options else {}))
    return UnityEnv(lambda seed: base, **options), base


def play(env, rounds, action=0.5):
    """Return the rows of ``rounds`` rounds, as a collector would see them."""
    rows, td = [], env.reset()
    for _ in range(rounds):
        for name in td.keys():
            td.set(
                (name, "action"), torch.full_like(env.rand_action(td.copy()).get((name, "action")), action)
            )
        row, td = env.step_and_maybe_reset(td)
        rows.append(row)
    return torch.stack(rows), td


def column(rows, key, name="Fake"):
    return rows.get((*key[:-1], name, key[-1])).squeeze(-1).squeeze(-1).tolist()


def test_a_terminal_step_and_the_next_first_decision_in_one_result():
    env, _ = open_env(
        [
            [R(0, obs=1)],
            [R(0, obs=2, reward=0.5)],
            [R(0, obs=9, reward=1.0, ends=END), R(0, obs=3, reward=0.25)],
            [R(0, obs=4, reward=0.125)],
        ]
    )
    rows, _ = play(env, 3)
    assert rows["Fake", "obs_0"].flatten().tolist() == [1, 2, 3]
    assert rows["next", "Fake", "obs_0"].flatten().tolist() == [2, 9, 4]
    # what the first decision of the new episode brings (0.25) was earned by no action
    assert rows["next", "Fake", "reward"].flatten().tolist() == [0.5, 1.0, 0.125]
    assert rows["next", "Fake", "terminated"].flatten().tolist() == [False, True, False]
    assert rows["Fake", "acting"].all()
    episode = env.pop_episodes()["Fake?team=0"][0]
    assert (episode.individual_return, episode.length, episode.interrupted) == (1.5, 2, False)


def test_results_with_terminals_only_are_stepped_over():
    env, base = open_env(
        [
            [R(0, obs=1), R(1, obs=1)],
            [R(0, obs=8, reward=-1, ends=END)],
            [R(1, obs=7, reward=2, ends=CUT)],
            [R(0, obs=2), R(1, obs=3)],
            [R(0), R(1)],
        ]
    )
    rows, _ = play(env, 2)
    assert base.at == 4
    assert rows["next", "Fake", "reward"][0].flatten().tolist() == [-1, 2]
    assert rows["next", "Fake", "terminated"][0].flatten().tolist() == [True, False]
    assert rows["next", "Fake", "truncated"][0].flatten().tolist() == [False, True]
    assert rows["next", "Fake", "obs_0"][0].flatten().tolist() == [8, 7]
    assert rows["Fake", "obs_0"][1].flatten().tolist() == [2, 3]


def test_agents_that_were_not_asked_get_no_action_and_their_reward_comes_later():
    env, base = open_env(
        [
            [R(0, obs=1), R(1, obs=1)],
            [R(1, obs=2, reward=0.1)],
            [R(0, obs=3, reward=5), R(1, obs=3, reward=0.1)],
            [R(0), R(1)],
        ]
    )
    rows, _ = play(env, 3)
    assert rows["Fake", "acting"].squeeze().tolist() == [[True, True], [False, True], [True, True]]
    assert rows["Fake", "present"].all()
    assert rows["next", "Fake", "reward"][:, 0].flatten().tolist() == [0, 5, 0]
    assert [len(a[1]) for a in base.actions] == [2, 1, 2]


def test_new_ids_take_the_slots_of_those_that_ended():
    env, _ = open_env(
        [
            [R(0, obs=1), R(1, obs=2)],
            [R(1, ends=END), R(0, obs=1)],
            [R(7, obs=5), R(0, obs=1)],
            [R(7, obs=6, reward=1), R(0)],
        ]
    )
    rows, _ = play(env, 3)
    assert rows["Fake", "acting"].squeeze().tolist() == [[True, True], [True, False], [True, True]]
    assert rows["Fake", "obs_0"][2].flatten().tolist() == [1, 5]
    assert rows["next", "Fake", "reward"][2].flatten().tolist() == [0, 1]
    assert not rows["Fake", "present"][1, 1].any()


def test_more_agents_than_slots_is_an_error_that_names_the_option():
    script = [[R(0)], [R(0), R(1)]]
    env, _ = open_env(script)
    with pytest.raises(ConfigError, match=r"agent 1.*env\.max_teams=2"):
        play(env, 1)
    env, _ = open_env(script, max_teams=2)
    rows, _ = play(env, 1)
    assert rows["Fake", "acting"].flatten().tolist() == [True, False]
    env, _ = open_env([[R(0, group=1)], [R(0, group=1), R(1, group=1)]])
    with pytest.raises(ConfigError, match=r"agent 1.*group 1.*env\.max_team_size=2"):
        play(env, 1)


def test_a_member_that_dies_earns_its_teams_reward_until_the_team_ends():
    group = {"group": 1}
    env, _ = open_env(
        [
            [R(0, **group), R(1, **group)],
            [R(0, ends=END, reward=-0.5, **group), R(1, **group)],
            [R(1, group_reward=0.25, **group)],
            [R(1, ends=END, group_reward=1.0, **group)],
            [R(5, **group), R(6, **group)],
            [R(5, **group), R(6, **group)],
        ]
    )
    rows, _ = play(env, 4)
    dead = {
        key: rows["next", "Fake", key][:, 0, 0, 0].tolist()
        for key in ("reward", "group_reward", "terminated")
    }
    assert dead["reward"] == [-0.5, 0, 0, 0]
    assert dead["group_reward"] == [0, 0.25, 1.0, 0]
    assert dead["terminated"] == [False, False, True, False]
    assert rows["Fake", "departed"][:, 0, 0, 0].tolist() == [False, True, True, False]
    assert rows["Fake", "acting"][:, 0, 0, 0].tolist() == [True, False, False, True]
    assert rows["next", "Fake", "terminated"][:, 0, 1, 0].tolist() == [False, False, True, False]


def test_without_death_masking_a_member_ends_when_it_ends():
    group = {"group": 1}
    env, _ = open_env(
        [
            [R(0, **group), R(1, **group)],
            [R(0, ends=END, reward=-0.5, **group), R(1, **group)],
            [R(1, group_reward=0.25, **group)],
        ],
        death_masking=False,
    )
    rows, _ = play(env, 2)
    assert rows["next", "Fake", "terminated"][:, 0, 0, 0].tolist() == [True, False]
    assert rows["next", "Fake", "group_reward"][:, 0, 0, 0].tolist() == [0, 0]


def test_an_agent_that_moves_to_another_behavior():
    names = {"Small?team=0": behavior_spec(1), "Big?team=0": behavior_spec(2)}
    small, big = ({"behavior": name} for name in names)
    env, _ = open_env(
        [
            [R(0, obs=1, **small), R(1, obs=1, **big)],
            [R(0, obs=2, reward=1, ends=END, **small), R(1, obs=2, **big)],
            [R(0, obs=3, **big), R(1, obs=3, **big)],
            [R(0, obs=4, reward=2, **big), R(1, obs=4, **big)],
        ],
        specs=names,
        max_teams=2,
    )
    rows, _ = play(env, 3)
    assert rows["next", "Small", "terminated"][0].flatten().tolist() == [True, False]
    assert rows["Big", "acting"][2].flatten().tolist() == [True, True]
    assert rows["next", "Big", "reward"][2].flatten().tolist() == [0, 2]
    assert not rows["Small", "acting"][1:].any()


def test_terminals_of_agents_that_were_never_asked_are_nobodys():
    env, _ = open_env([[R(0)], [R(9, ends=END, reward=5)], [R(0, reward=1)]])
    rows, _ = play(env, 1)
    assert rows["next", "Fake", "reward"].flatten().tolist() == [1]
    assert not rows["next", "Fake", "done"].any()


def test_partial_resets_never_reset_the_scene_and_a_second_full_reset_does_nothing():
    env, base = open_env([[R(0, obs=1)], [R(0, ends=END), R(0, obs=2)], [R(0, obs=3)]])
    env.reset()
    env.reset()
    assert base.resets == 1
    play(env, 2)
    assert base.resets == 1
    td = env.reset()
    assert base.resets == 2
    assert td["Fake", "obs_0"].item() == 1


def test_continuous_actions_are_clipped_and_scaled_to_unity_s_range():
    env, base = open_env([[R(0)], [R(0)], [R(0)]], action_limit=3.0)
    play(env, 1, action=1.5)
    play(env, 1, action=7.0)
    assert [a[1].item() for a in base.actions] == [0.5, 1.0]


def test_masks_turn_round_and_a_fully_masked_branch_names_the_agent():
    specs = {"Fake?team=0": behavior_spec(1, ActionSpec(0, (2, 3)))}
    free = [[False, True], [False, False, False]]
    env, _ = open_env([[R(0, mask=free)], [R(3, mask=[[True, True], [False] * 3])]], specs=specs, max_teams=2)
    td = env.reset()
    assert td["Fake", "action_mask"][0, 0].tolist() == [True, False, True, True, True]
    td["Fake", "action"] = torch.zeros(2, 1, 2, dtype=torch.int64)
    with pytest.raises(EnvironmentDataError, match="agent 3.*branch 0"):
        env.step(td)


def test_a_decision_without_a_mask_forbids_nothing():
    specs = {"Fake?team=0": behavior_spec(1, ActionSpec(0, (2,)))}
    env, base = open_env([[R(0, mask=[[False, True]])], [R(0)], [R(0)]], specs=specs)
    give = base.get_steps

    def give_no_mask(name):
        decision, terminal = give(name)
        decision.action_mask = decision.action_mask if base.at == 0 else None
        return decision, terminal

    base.get_steps = give_no_mask
    td = env.reset()
    assert td["Fake", "action_mask"].flatten().tolist() == [True, False]
    td["Fake", "action"] = torch.zeros(1, 1, 1, dtype=torch.int64)
    assert env.step(td)["next", "Fake", "action_mask"].flatten().tolist() == [True, True]


def test_an_environment_may_write_into_the_same_arrays_again():
    env, base = open_env([[R(0), R(1)], [R(0, obs=7, ends=END)], [R(1, obs=3), R(0, obs=4)]])
    give, seen = base.get_steps, np.zeros((2, 1), np.float32)

    def give_the_same_array(name):
        for steps in (result := give(name)):
            if len(steps):
                seen[: len(steps)] = steps.obs[0]
                steps.obs = [seen[: len(steps)]]
        return result

    base.get_steps = give_the_same_array
    rows, _ = play(env, 1)
    assert rows["next", "Fake", "obs_0"].flatten().tolist() == [7, 3]


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_name_behavior_agent_and_sensor(bad):
    env, _ = open_env([[R(0), R(4)], [R(0), R(4, obs=bad)]])
    with pytest.raises(
        EnvironmentDataError, match=r"'Fake\?team=0', agent 4: its sensor obs_0 \(vector\) holds (nan|inf)"
    ):
        play(env, 1)
    env, _ = open_env([[R(0)], [R(0, reward=bad)]])
    with pytest.raises(EnvironmentDataError, match="agent 0: its reward"):
        play(env, 1)


def test_two_sides_are_two_entries_and_one_policy():
    names = {"Soccer?team=1": behavior_spec(), "Soccer?team=0": behavior_spec()}
    script = [[R(0, behavior="Soccer?team=1"), R(1, behavior="Soccer?team=0")]] * 2
    env, _ = open_env(script, specs=names)
    assert env.sides == {"Soccer": ["Soccer?team=1", "Soccer?team=0"]}
    assert set(env.reset().keys()) == set(names)


@pytest.mark.parametrize("areas", [1, 5])
def test_check_env_specs_on_a_scene(areas):
    env = UnityEnv(lambda seed: make_scene("3DBall", seed=seed, num_areas=areas))
    check_env_specs(env, seed=0)
    env.close()


def test_seeds_decide_the_episodes():
    def observations(seed):
        env = UnityEnv(lambda s: make_scene("3DBall", seed=s, num_areas=4))
        env.set_seed(seed)
        torch.manual_seed(0)
        out = env.rollout(50, break_when_any_done=False)["3DBall", "obs_0"].numpy()
        env.close()
        return out

    assert np.array_equal(observations(3), observations(3))
    assert not np.array_equal(observations(3), observations(4))


def test_a_state_goes_on_to_the_bit():
    env = UnityEnv(lambda seed: make_scene("3DBall", seed=seed, num_areas=6))
    play(env, 20)
    state = env.get_state()
    first, _ = play_on(env, 30)
    other = UnityEnv(lambda seed: make_scene("3DBall", seed=seed + 1, num_areas=6))
    other.set_state(state)
    second, _ = play_on(other, 30)
    for key in first.keys(True, True):
        assert torch.equal(first[key], second[key]), key
    # each environment counts its own rounds
    ended = [[e._replace(round=0) for e in one.pop_episodes()["3DBall?team=0"][-3:]] for one in (env, other)]
    assert ended[0] == ended[1]


def play_on(env, rounds):
    env._untouched = True  # the next reset hands out where it stands
    return play(env, rounds)
