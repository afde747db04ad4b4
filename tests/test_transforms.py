"""Rounds of `TransformedUnityEnv` hold what TorchRL's own `TransformedEnv` gives, entry by entry."""

import pytest
import torch
from fakes import Record as R
from fakes import ScriptedEnv, behavior_spec
from mlagents_envs.base_env import ActionSpec
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.modules import ProbabilisticActor

from mappo_unity.config.schema import ModelConfig
from mappo_unity.envs.transforms import make_transforms, transformed
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.learning.networks.actor_critic import make_actor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.networks.joint_policy import JointPolicy
from mappo_unity.scenes import make_scene
from mappo_unity.training.collection.worker import make_collector

END, CUT = "terminated", "interrupted"


def alone():
    """Ends with and without a decision in the same result, staggered agents, an agent that is replaced."""
    return {"Fake?team=0": behavior_spec(2)}, [
        [R(0, obs=1), R(1, obs=1)],
        [R(0, obs=9, reward=1, ends=END), R(0, obs=2), R(1, obs=2, reward=0.5)],
        [R(1, obs=8, ends=CUT, reward=-1), R(0, obs=3)],
        [R(0, obs=4, reward=2)],
        [R(7, obs=5), R(0, obs=7, ends=END)],
        [R(7, obs=6), R(0, obs=6)],
    ]


def team():
    """A member that departs before its team ends."""
    group = {"group": 1}
    return {"Fake?team=0": behavior_spec()}, [
        [R(0, obs=1, **group), R(1, obs=1, **group)],
        [R(0, obs=9, ends=END, reward=-0.5, **group), R(1, obs=2, **group)],
        [R(1, obs=3, group_reward=0.25, **group)],
        [R(1, obs=8, ends=END, group_reward=1, **group)],
        [R(5, obs=4, **group), R(6, obs=4, **group)],
        [R(5, obs=5, **group), R(6, obs=5, **group)],
    ]


def behaviors():
    """Two policies with other actions; an agent moves from one to the other."""
    small, big = {"behavior": "Small?team=0"}, {"behavior": "Big?team=0"}
    free = {"mask": [[False, True, False]]}
    return {"Small?team=0": behavior_spec(1), "Big?team=0": behavior_spec(2, ActionSpec(0, (3,)))}, [
        [R(0, obs=1, **small), R(1, obs=1, **big)],
        [R(0, obs=2, reward=1, ends=END, **small), R(1, obs=2, **big, **free)],
        [R(0, obs=3, **big), R(1, obs=3, **big)],
        [R(0, obs=9, reward=2, ends=CUT, **big), R(1, obs=4, **big), R(0, obs=4, **big)],
        [R(0, obs=5, **big), R(1, obs=5, **big)],
    ]


def sides():
    """Two sides under one name; one ends alone, then both."""
    one, two = {"behavior": "Soccer?team=1"}, {"behavior": "Soccer?team=0"}
    both = [R(0, obs=1, **one), R(1, obs=2, **two)]
    return {"Soccer?team=1": behavior_spec(2), "Soccer?team=0": behavior_spec(2)}, [
        both,
        [R(0, obs=9, ends=END, reward=5, **one), *both],
        both,
        [R(0, obs=8, ends=CUT, **one), R(1, obs=7, ends=END, reward=1, **two), *both],
        both,
    ]


def scripted(specs, script):
    return UnityEnv(lambda seed: ScriptedEnv(script, specs), max_teams=2)


def scene(name):
    return UnityEnv(lambda seed: make_scene(name, seed=seed, num_areas=2))


def torchrl_s_own(env):
    return TransformedEnv(env, make_transforms(env))


def play(env, rounds, own=()):
    """Return rows and roots of rounds with random actions, and with entries as an actor writes them."""
    torch.manual_seed(0)
    rows, roots, td = [], [], env.reset()
    for _ in range(rounds):
        td = env.rand_action(td)
        for name in env.base_env.sides:
            entries = td.get(name)
            entries.update({key: torch.rand(entries.shape) for key in own})
        row, td = env.step_and_maybe_reset(td)
        rows.append(row.clone())
        roots.append(td.clone())
    return rows, roots


def assert_same(ours, theirs, leftovers=()):
    """Compare, but for what TorchRL leaves in a root of the round before."""
    for number, (own, other) in enumerate(zip(ours, theirs, strict=True)):
        expected = {key for key in other.keys(True) if key[-1] not in leftovers}
        assert set(own.keys(True)) == expected, number
        assert own.device == other.device
        for key in expected:
            assert own[key].shape == other[key].shape, (number, key)
            if not hasattr(own[key], "keys"):
                assert own[key].dtype == other[key].dtype, (number, key)
                assert torch.equal(own[key], other[key]), (number, key)


def count_torchrl_s_rounds(monkeypatch):
    """Count the rounds that are left to TorchRL."""
    calls, theirs = [], TransformedEnv.step_and_maybe_reset

    def counted(self, tensordict):
        calls.append(type(self))
        return theirs(self, tensordict)

    monkeypatch.setattr(TransformedEnv, "step_and_maybe_reset", counted)
    return calls


@pytest.mark.parametrize("script", [alone, team, behaviors, sides])
@pytest.mark.parametrize("device", [None, "cpu"])
def test_rounds_are_those_of_torchrl(script, device, monkeypatch):
    specs, results = script()
    rounds, calls = len(results) - 2, count_torchrl_s_rounds(monkeypatch)
    lean, plain = (make(scripted(specs, results)) for make in (transformed, torchrl_s_own))
    if device is not None:
        lean, plain = lean.to(device), plain.to(device)
    (rows, roots), (their_rows, their_roots) = (
        play(env, rounds, ["action_log_prob"]) for env in (lean, plain)
    )
    assert_same(rows, their_rows)
    assert_same(roots, their_roots, {"action", "action_log_prob"})
    assert calls == [TransformedEnv] * rounds
    assert any(row["next", name, "done"].any() for row in rows for name in lean.base_env.sides)


@pytest.mark.parametrize("name", ["3DBall", "SoccerTwos", "WallJump", "DungeonEscape"])
def test_rounds_of_scenes_are_those_of_torchrl(name):
    (rows, roots), (their_rows, their_roots) = (
        play(make(scene(name)), 60) for make in (transformed, torchrl_s_own)
    )
    assert_same(rows, their_rows)
    assert_same(roots, their_roots, {"action"})


def test_entries_of_other_policies_are_left_to_torchrl():
    specs, results = alone()
    (rows, roots), (their_rows, their_roots) = (
        play(make(scripted(specs, results)), 4, ["hidden"]) for make in (transformed, torchrl_s_own)
    )
    assert_same(rows, their_rows)
    assert_same(roots, their_roots)
    assert roots[0]["Fake", "hidden"][0] == 0 and roots[0]["Fake", "hidden"][1] != 0  # agent 0 had ended


def test_other_transforms_are_left_to_torchrl():
    lean, plain = (make(scripted(*alone())) for make in (transformed, torchrl_s_own))
    for env in (lean, plain):
        play(env, 1)
        env.append_transform(StepCounter())
    (rows, roots), (their_rows, their_roots) = (play(env, 4) for env in (lean, plain))
    assert_same(rows, their_rows)
    assert_same(roots, their_roots)
    assert rows[3]["Fake", "step_count"].flatten().tolist() == [2, 1]  # both ended once


@pytest.mark.parametrize("script", [behaviors, sides])
@pytest.mark.parametrize("device", ["cpu", "cpu:0"])  # the second one goes the way between devices
def test_batches_are_those_of_torchrl(script, device):
    specs, results = script()
    batches = []
    for make in (transformed, torchrl_s_own):
        env = make(scripted(specs, results))
        policy = policy_of(env)
        torch.manual_seed(0)
        if make is torchrl_s_own:
            for actor in policy.actors.values():
                actor.__class__ = ProbabilisticActor  # it cannot be asked for draws alone
        collector = make_collector(env, policy, len(results) - 2, device)
        batches.append(next(iter(collector)))
        collector.shutdown()
    assert_same(batches[:1], batches[1:])


def test_a_batch_stays_as_it_was_while_the_next_is_collected():
    env = transformed(scene("3DBall"))
    batches = iter(make_collector(env, policy_of(env), 5))
    first = next(batches)
    kept = first.clone()
    assert_same([first], [kept])
    next(batches)
    assert_same([first], [kept])


def policy_of(env):
    """Return small actors for an environment, always the same."""
    torch.manual_seed(1)
    actors = {}
    for name, behaviors in env.base_env.sides.items():
        behavior = env.base_env.behaviors[behaviors[0]]
        obs = ObsLayout.from_specs(behavior.spec.observation_specs)
        layout = ActionLayout.from_spec(behavior.spec.action_spec)
        actors[name] = make_actor(obs, layout, behavior.slots.team_size, ModelConfig(hidden=[8]))
    return JointPolicy(actors)
