"""Demonstrations: what is recorded is read back, by us and by ML-Agents; what cannot be read is told."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import Record, ScriptedEnv, behavior_spec, vector_spec
from mlagents_envs.base_env import (
    ActionSpec,
    ActionTuple,
    BehaviorSpec,
    DecisionSteps,
    DimensionProperty,
    ObservationType,
    TerminalSteps,
)

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.demos import demo_file
from mappo_unity.protocol.demos.demonstration import Demonstration, check_matches
from mappo_unity.protocol.demos.reader import read_demo, read_demos
from mappo_unity.protocol.demos.recording_env import RecordingEnv, recording_files
from mappo_unity.protocol.demos.writer import DemoWriter
from mappo_unity.protocol.encode import BehaviorEncoder
from mappo_unity.protocol.protobuf import install
from mappo_unity.scenes.contract.images import ByteImage
from mappo_unity.scenes.registry import make_scene

install()
from mlagents_envs.communicator_objects.agent_info_action_pair_pb2 import (  # noqa: E402
    AgentInfoActionPairProto,
)

NAME = "Fake?team=0"
HYBRID = ActionSpec(1, (3, 2))
FORBIDDEN = [[False, True, False], [False, False]]
SCRIPT = [
    [Record(1, obs=10, reward=5), Record(2, obs=20)],
    [Record(1, obs=11, reward=1, group_reward=0.5, mask=FORBIDDEN)],
    [Record(1, obs=12, reward=2, ends="terminated"), Record(1, obs=13), Record(2, obs=21, reward=-1)],
    [Record(2, obs=22, reward=4, ends="interrupted")],
    [Record(1, obs=14, reward=3), Record(3, obs=30)],
]


def play(env: RecordingEnv | ScriptedEnv, steps: int) -> None:
    """Play; decision number d gets the continuous action d / 10 and the branches (d % 3, d % 2)."""
    env.reset()
    number = 0
    for _ in range(steps):
        for name in env.behavior_specs:
            decision, _ = env.get_steps(name)
            numbers = np.arange(number, number + len(decision))
            number += len(decision)
            if len(decision):
                branches = np.stack([numbers % 3, numbers % 2], 1).astype(np.int32)
                env.set_actions(name, ActionTuple(numbers[:, None].astype(np.float32) / 10, branches))
        env.step()


def recorded(path: Path) -> Demonstration:
    env = RecordingEnv(ScriptedEnv(SCRIPT, {NAME: behavior_spec(2, HYBRID)}), path)
    play(env, len(SCRIPT) - 1)
    env.close()
    assert [(r.path, r.episodes, r.decisions) for r in env.recorded] == [(path, 3, 5)]
    return read_demo(path)


def test_whole_episodes_of_all_agents_come_back(tmp_path: Path) -> None:
    demo = recorded(tmp_path / "run.demo")

    # In the order of their ends: agent 1's first episode, agent 2's, agent 1's second, which was cut off.
    assert demo.obs()[0][:, 0].tolist() == [10, 11, 20, 21, 13]
    assert demo.next_obs()[0][:, 0].tolist() == [11, 12, 21, 22, 14]
    assert demo.next_obs([1, 4])[0].tolist() == [[12, 12], [14, 14]]
    assert demo.continuous[:, 0].tolist() == pytest.approx([0.0, 0.2, 0.1, 0.4, 0.3])
    assert demo.discrete.tolist() == [[0, 0], [2, 0], [1, 1], [1, 0], [0, 1]]
    assert demo.reward.tolist() == [1, 2, -1, 4, 3] and demo.group_reward.tolist() == [0.5, 0, 0, 0, 0]
    assert demo.done.tolist() == [False, True, False, True, True]
    assert demo.interrupted.tolist() == [False, False, False, True, True]
    assert demo.first.tolist() == [True, False, True, False, True] and demo.has_action.all()
    assert demo.returns.tolist() == [3.5, 3, 3] and len(demo) == 5
    assert demo.mask is not None and demo.mask[1].tolist() == [True, False, True, True, True]
    assert demo.mask[0].all() and demo.behavior == "Fake"
    assert (demo.continuous.dtype, demo.discrete.dtype, demo.reward.dtype) == ("f4", "i4", "f4")
    assert demo.spec.action_spec == HYBRID
    assert demo.spec.observation_specs == [vector_spec(2)]


def test_files_and_folders_are_joined_in_order(tmp_path: Path) -> None:
    one = recorded(tmp_path / "b.demo")
    recorded(tmp_path / "a.demo")
    (tmp_path / "notes.txt").write_text("not a demonstration")
    both = read_demo(tmp_path)
    assert both.source == f"{tmp_path}/a.demo, {tmp_path}/b.demo"
    assert both.obs()[0].tolist() == 2 * one.obs()[0].tolist()
    assert both.next_obs()[0].tolist() == 2 * one.next_obs()[0].tolist()
    assert both.first.sum() == 6 and len(both.frames[0]) == 2 * len(one.frames[0])
    assert both.mask is not None and both.mask.shape == (10, 5)
    assert len(read_demos([tmp_path, str(tmp_path / "a.demo")])) == 15


def test_pictures_and_numbers_of_one_sensor_come_back(tmp_path: Path) -> None:
    flat, none = DimensionProperty.TRANSLATIONAL_EQUIVARIANCE, DimensionProperty.NONE
    camera = ByteImage((4, 4, 3), (flat, flat, none), ObservationType.DEFAULT, "camera")
    spec = BehaviorSpec([camera, vector_spec(1)], ActionSpec(0, (2,)))
    levels = np.arange(48, dtype=np.float32).reshape(1, 4, 4, 3) / np.float32(255)
    writer = DemoWriter(tmp_path / "run.demo", "Camera", spec)
    none_of, alone = np.zeros(1, np.int32), np.zeros((1, 1), np.float32)
    shots = [levels, levels * np.float32(0.37), levels]  # a PNG holds the first and the last exactly
    for shot in shots:
        action = ActionTuple(discrete=np.ones((1, 1), np.int32))
        steps = DecisionSteps([shot, alone], alone[0], none_of, None, none_of, alone[0])
        writer.record(steps, TerminalSteps.empty(spec), action)
    writer.close()

    demo = read_demo(tmp_path / "run.demo")
    assert b"PNG" in (tmp_path / "run.demo").read_bytes()
    assert np.array_equal(demo.frames[0], np.concatenate(shots)) and len(demo) == 2
    assert demo.spec.observation_specs[0] == camera


def unity_file(
    path: Path, actions: Sequence[int], done: Sequence[bool], old: bool = False, tail: bool = True
) -> None:
    """Write a file as Unity's recorder does: `actions` and `done` as they stand in its records."""
    spec = behavior_spec(1, ActionSpec(0, (9,)))
    encoder = BehaviorEncoder(NAME, spec)
    content = b""
    for number, (action, ends) in enumerate(zip(actions, done)):
        kind = "terminated" if ends else None
        env = ScriptedEnv([[Record(7, obs=number, reward=number, ends=kind)]], {NAME: spec})
        env.reset()
        pair = AgentInfoActionPairProto.FromString(encoder.encode(*env.get_steps(NAME)))
        if old:
            pair.action_info.vector_actions_deprecated.append(action)
        else:
            pair.action_info.discrete_actions.append(action)
        content += demo_file.delimited(pair.SerializeToString())
    head = demo_file.header(path.stem, len(actions), 1 + sum(done), 0.0)
    ending = head.rstrip(b"\0")[1:] if tail else b""
    path.write_bytes(head + demo_file.delimited(encoder.brain_parameters()) + content + ending)


END = [False, False, False, True, False, False]


def test_a_file_of_unity_holds_each_action_one_record_later(tmp_path: Path) -> None:
    # Taken were 1, 2, 3 and, in the second episode, 4; the last of an episode is written at its end.
    unity_file(tmp_path / "old.demo", [0, 1, 2, 3, 0, 4], END, old=True)
    demo = read_demo(tmp_path / "old.demo")
    assert demo.discrete[:, 0].tolist() == [1, 2, 3, 4] and demo.has_action.all()
    assert demo.obs()[0][:, 0].tolist() == [0, 1, 2, 4] and demo.reward.tolist() == [1, 2, 3, 5]
    assert demo.done.tolist() == [False, False, True, False]


def test_unity_since_1_5_does_not_record_the_last_action_of_an_episode(tmp_path: Path) -> None:
    unity_file(tmp_path / "new.demo", [0, 1, 2, 2, 0, 4], END)
    demo = read_demo(tmp_path / "new.demo")
    assert demo.discrete[:, 0].tolist() == [1, 2, 2, 4]
    assert demo.has_action.tolist() == [True, True, False, True]
    # where an end has an action of its own, another recorder wrote it
    unity_file(tmp_path / "other.demo", [0, 1, 2, 3, 0, 4], END)
    assert read_demo(tmp_path / "other.demo").has_action.all()


def test_a_file_without_the_tail_is_not_shifted(tmp_path: Path) -> None:
    unity_file(tmp_path / "run.demo", [1, 2, 3, 0, 4, 0], END, tail=False)
    assert read_demo(tmp_path / "run.demo").discrete[:, 0].tolist() == [1, 2, 3, 4]
    with (tmp_path / "run.demo").open("ab") as file:
        file.write(b"something else")
    assert read_demo(tmp_path / "run.demo").discrete[:, 0].tolist() == [1, 2, 3, 4]


def test_an_agent_that_others_interrupt_is_not_paired_with_them(tmp_path: Path) -> None:
    path = tmp_path / "run.demo"
    unity_file(path, [1, 2, 3, 4], [False] * 4, tail=False)
    data = path.read_bytes()
    assert data.count(b"\x50\x07") == 4  # field 10, the agent's id
    halves = data.rsplit(b"\x50\x07", 2)
    path.write_bytes(b"\x50\x08".join(halves))
    demo = read_demo(path)
    assert demo.discrete[:, 0].tolist() == [1, 3] and demo.first.all() and not demo.done.any()


def change(content: bytes, at: int, by: bytes) -> bytes:
    return content[:at] + by + content[at + len(by) :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: b"", r"demonstration \S+run.demo is empty"),
        (
            lambda data: b"no demonstration at all, " * 9,
            "run.demo is no demonstration of ML-Agents: its head",
        ),
        (lambda data: b"\x02\xff\xff" + data[3:], "run.demo is no demonstration of ML-Agents, or it is dam"),
        (lambda data: data[:5], "run.demo is no demonstration of ML-Agents: its header"),
        (lambda data: data[:40], "run.demo is cut short: it should have 8 records, 0 are there"),
        (lambda data: data[:-50], r"run.demo is cut short: it should have 8 records, 7 are there"),
        (lambda data: change(data, 2, b"\x07"), "has version 7; the versions that can be read are 0 and 1"),
        (lambda data: demo_file.header("x", 0, 0, 0) + data[33:], "has no records: was the recording not"),
        (lambda data: demo_file.header("x", 1, 0, 0) + data[33:], "has no decision that anything followed"),
    ],
)
def test_a_file_that_cannot_be_read_is_told(tmp_path: Path, damage: Any, message: str) -> None:
    path = tmp_path / "run.demo"
    recorded(path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ConfigError, match=message) as caught:
        read_demo(path)
    assert "\n" not in str(caught.value)


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nowhere.demo does not exist: give a .demo file, or a folder"):
        read_demo(tmp_path / "nowhere.demo")
    with pytest.raises(ConfigError, match="holds no demonstration: it has no file that ends in .demo"):
        read_demo(tmp_path)
    with pytest.raises(ConfigError, match="no demonstration is named"):
        read_demos([])


def test_records_that_nobody_can_use_are_told(tmp_path: Path) -> None:
    path = tmp_path / "run.demo"
    unity_file(path, [0, 9, 0], [False] * 3)
    with pytest.raises(ConfigError, match=r"run.demo is damaged: a discrete action .* of sizes \(9,\)"):
        read_demo(path)
    path.unlink()
    recorded(path)
    data = path.read_bytes()
    path.write_bytes(data.replace(np.float32(12).tobytes(), np.float32(np.nan).tobytes()))
    with pytest.raises(ConfigError, match="run.demo is damaged: Fake, agent 1: its sensor obs_0 holds nan"):
        read_demo(path)


def test_every_difference_from_the_behavior_is_named(tmp_path: Path) -> None:
    demo = recorded(tmp_path / "run.demo")
    check_matches(demo, behavior_spec(2, HYBRID), "Other?team=1")
    with pytest.raises(ConfigError) as caught:
        check_matches(demo, behavior_spec(3, ActionSpec(2, (3,))), "Ball")
    assert str(caught.value) == (
        f"demonstration {tmp_path}/run.demo does not fit the behavior 'Ball': in the demonstration, sensor "
        "obs_0 has shape (2,), Ball's has (3,); actions have 1 continuous columns, Ball's have 2; discrete "
        "branches have sizes (3, 2), Ball's have (3,)"
    )
    two = BehaviorSpec([vector_spec(2), vector_spec(1)], HYBRID)
    with pytest.raises(
        ConfigError, match=r"there are 1 sensors with shapes \[\(2,\)\], Ball's are \[\(2,\), \(1"
    ):
        check_matches(demo, two, "Ball")

    unity_file(tmp_path / "unity.demo", [0, 1, 2], [False] * 3)
    with pytest.raises(
        ConfigError, match=r"run.demo and \S+unity.demo cannot be joined: in the second, sensor"
    ):
        read_demo(tmp_path)


def test_recordings_go_to_new_files_one_a_policy(tmp_path: Path) -> None:
    sides = ["Striker?team=0", "Striker?team=1"]
    assert recording_files(tmp_path / "run.demo", sides) == {"Striker": tmp_path / "run.demo"}
    both = [*sides, "Goal Keeper?team=0"]
    files = recording_files(tmp_path / "new" / "folder", both)
    assert files["Goal Keeper"] == tmp_path / "new" / "folder" / "Goal_Keeper.demo" and len(files) == 2
    with pytest.raises(
        ConfigError, match=r"a file is of one: name a folder, such as \S+/run/, for Striker.demo"
    ):
        recording_files(tmp_path / "run.demo", both)
    with pytest.raises(ConfigError, match=r"run.mp4 must end in .demo, or be a folder for NAME.demo"):
        recording_files(tmp_path / "run.mp4", sides)
    with pytest.raises(ConfigError, match=r"cannot be written: \S+/new is no folder that can be written"):
        recording_files(tmp_path / "new" / "run.demo", sides)
    (tmp_path / "run.demo").touch()
    with pytest.raises(ConfigError, match=r"run.demo exists already: give another name, or delete it"):
        RecordingEnv(ScriptedEnv(SCRIPT), tmp_path / "run.demo")


def test_several_behaviors_of_a_scene_go_to_a_folder(tmp_path: Path) -> None:
    env = RecordingEnv(make_scene("WallJump", seed=0, num_areas=4), tmp_path / "walls")
    env.reset()
    for _ in range(30):
        env.step()  # who gets no action gets ML-Agents' empty one
    env.close()
    assert env.num_areas == 4
    assert {r.path.name for r in env.recorded} == {"SmallWallJump.demo", "BigWallJump.demo"}
    for file in env.recorded:
        demo = read_demo(file.path)
        assert len(demo) == file.decisions > 0 and not demo.discrete.any()
        check_matches(demo, env.behavior_specs[f"{file.path.stem}?team=0"], file.path.stem)


def test_an_environment_that_fails_leaves_what_was_played(tmp_path: Path) -> None:
    env = RecordingEnv(ScriptedEnv(SCRIPT[:3]), tmp_path / "run.demo")
    with pytest.raises(AssertionError, match="the script is over"):
        for step in range(4):
            env.step() if step else env.reset()
    env.close()
    env.close()
    demo = read_demo(tmp_path / "run.demo")
    assert demo.obs()[0][:, 0].tolist() == [10, 11, 20] and env.closed
    assert demo.interrupted.tolist() == [False, False, True]
    assert [file.name for file in tmp_path.iterdir()] == ["run.demo"]


def test_a_reset_cuts_episodes_and_nothing_leaves_no_file(tmp_path: Path) -> None:
    env = RecordingEnv(ScriptedEnv(SCRIPT), tmp_path / "run.demo")
    for _ in range(2):
        env.reset()
        env.step()
    env.close()
    demo = read_demo(tmp_path / "run.demo")
    assert demo.obs()[0][:, 0].tolist() == [10, 10] and demo.interrupted.all() and demo.first.all()

    env = RecordingEnv(ScriptedEnv(SCRIPT), tmp_path / "nothing.demo")
    env.reset()
    env.close()
    assert [file.name for file in tmp_path.iterdir()] == ["run.demo"]


def test_actions_of_single_agents_are_recorded(tmp_path: Path) -> None:
    inner = ScriptedEnv(SCRIPT, {NAME: behavior_spec(1, HYBRID)})
    inner.set_action_for_agent = lambda *arguments: None  # type: ignore[method-assign]
    env = RecordingEnv(inner, tmp_path / "run.demo")
    env.reset()
    env.set_action_for_agent(
        NAME, 2, ActionTuple(np.array([[0.5]], np.float32), np.array([[2, 1]], np.int32))
    )
    env.step()
    env.step()
    env.close()
    demo = read_demo(tmp_path / "run.demo")
    assert demo.obs()[0][:, 0].tolist() == [10, 11, 20]
    assert demo.continuous[:, 0].tolist() == [0, 0, 0.5] and demo.discrete[2].tolist() == [2, 1]


def test_a_disk_that_is_full_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise OSError(28, "No space left on device")

    env = RecordingEnv(ScriptedEnv(SCRIPT), tmp_path / "run.demo")
    env.reset()
    env.step()
    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(ConfigError, match="run.demo cannot be written: No space left on device"):
        env.close()
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def unity_demos(shared: Path) -> Path:
    folder = shared / "mlagents" / "demos"
    if not folder.is_dir():
        pytest.skip(f"needs Unity's recordings ({folder} is not a folder)")
    return folder


@pytest.mark.parametrize(
    ("name", "decisions", "episodes", "total"),
    [
        # of the header's steps those at the ends of episodes, or of the recording, are no decisions
        ("3DBall", 548, 1, 54.8),
        ("Basic", 62, 11, 9.38),
        ("Hallway", 4304, 91, 79.308),
        ("PushBlock", 2462, 96, 472.538),
        ("Pyramid", 1741, 10, 16.268),
    ],
)
def test_recordings_of_the_real_scenes(
    unity_demos: Path, name: str, decisions: int, episodes: int, total: float
) -> None:
    demo = read_demo(unity_demos / f"Expert{name}.demo")
    assert (len(demo), len(demo.returns)) == (decisions, episodes)
    assert demo.returns.sum() == pytest.approx(total, abs=1e-3)
    assert demo.has_action.all() and demo.mask is None and not demo.interrupted.any()
    assert demo.done.sum() == episodes - 1  # the recording ends within the last one
    if len(demo.continuous[0]):
        assert np.abs(demo.continuous).max() == 1


def test_recordings_fit_the_embedded_scenes(unity_demos: Path) -> None:
    for name, file in (
        ("3DBall", "3DBall"),
        ("Basic", "Basic"),
        ("Hallway", "Hallway"),
        ("PushBlock", "PushBlock"),
        ("Pyramids", "Pyramid"),
    ):
        demo = read_demo(unity_demos / f"Expert{file}.demo")
        for behavior, spec in make_scene(name, num_areas=1).behavior_specs.items():
            check_matches(demo, spec, behavior)


def explained(result: np.ndarray, *causes: np.ndarray) -> float:
    """Return the share of a result's variance that a linear function of its causes explains."""
    matrix = np.concatenate([*causes, np.ones((len(result), 1))], 1)
    rest = result - matrix @ np.linalg.lstsq(matrix, result, rcond=None)[0]
    return float(1 - rest.var() / result.var())


def test_actions_are_paired_with_what_they_did(unity_demos: Path) -> None:
    ball = read_demo(unity_demos / "Expert3DBall.demo")  # an older recorder's, not shifted
    turned = (ball.next_obs()[0] - ball.obs()[0])[:, 0]
    assert np.corrcoef(turned, ball.continuous[:, 0])[0, 1] > 0.99

    pyramid = read_demo(unity_demos / "ExpertPyramid.demo")  # shifted: sensor 3 ends with the velocity
    forward, speed = np.eye(5)[pyramid.discrete[:, 0]], pyramid.obs()[3][:, 1:]
    late = pyramid.next_obs()[3][:, 3]
    assert explained(late, speed, forward) > 0.95 > 0.9 > explained(late[1:], speed[1:], forward[:-1])


LOAD = """
import json, sys
import numpy as np
from mlagents.trainers.demo_loader import load_demonstration, make_demo_buffer
spec, pairs, expected = load_demonstration(sys.argv[1])[:3]
out = {str(key): np.array(rows).tolist() for key, rows in make_demo_buffer(pairs, spec, 1).items()}
print(json.dumps({"count": len(pairs), "expected": expected, "spec": str(spec.action_spec)} | out))
"""


def test_the_loader_of_ml_agents_makes_the_same_pairs(tmp_path: Path) -> None:
    python = os.environ.get("MAPPO_MLAGENTS_PYTHON")
    if not python:
        pytest.skip("needs MAPPO_MLAGENTS_PYTHON, a Python that has mlagents 0.28")
    demo = recorded(tmp_path / "run.demo")
    run = subprocess.run(
        [python, "-c", LOAD, str(tmp_path / "run.demo")], capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    loaded = json.loads(run.stdout.splitlines()[-1])

    # It takes the end of an episode for a decision, too; those of the file's last episode excepted.
    assert loaded["count"] == loaded["expected"] == 8
    decisions = [0, 1, 3, 4, 6]
    column = {key.split(".")[-1]: rows for key, rows in loaded.items() if key.startswith("BufferKey")}
    obs = next(rows for key, rows in loaded.items() if "OBSERVATION" in key)
    assert np.array(obs)[decisions].tolist() == demo.obs()[0].tolist()
    assert np.array(column["CONTINUOUS_ACTION"])[decisions] == pytest.approx(demo.continuous)
    assert np.array(column["DISCRETE_ACTION"])[decisions].tolist() == demo.discrete.tolist()
    assert np.array(column["ENVIRONMENT_REWARDS"])[decisions].tolist() == demo.reward.tolist()
    assert np.array(column["DONE"])[decisions].tolist() == demo.done.tolist()
