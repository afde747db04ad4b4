"""What the rows of a round say of episodes: first decisions, ends, team mates that departed, moves."""

import torch
from fakes import Record as R
from fakes import ScriptedEnv, behavior_spec

from mappo_unity.envs.transforms import transformed
from mappo_unity.envs.unity_env import UnityEnv

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
