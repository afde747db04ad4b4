"""mappo-player seen by other people's clients, and the bytes on the wire."""

from __future__ import annotations

import contextlib
import logging
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import vector_spec

from mappo_unity.cli import player_main
from mappo_unity.cli.player import run as main
from mappo_unity.cli.players import options as player_options
from mappo_unity.cli.players.log import PlayerLog
from mappo_unity.errors import ConfigError
from mappo_unity.protocol import decode, encode, messages
from mappo_unity.protocol.batch_encoding import varint_columns
from mappo_unity.protocol.serve import Player, env_function, play, serve
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.images import ByteImage
from mappo_unity.scenes.registry import BUILT_IN

from mlagents_envs.base_env import (  # isort: skip  # mappo_unity lets it import
    ActionSpec,
    ActionTuple,
    BehaviorSpec,
    DecisionSteps,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
    TerminalSteps,
)

MIXED = BehaviorSpec([vector_spec(3, "first"), vector_spec(2, "second")], ActionSpec(2, (3, 300)))
PICTURE = BehaviorSpec(
    [
        vector_spec(2),
        ByteImage((4, 5, 3), (DimensionProperty.NONE,) * 3, ObservationType.DEFAULT, "camera"),
        ByteImage((4, 6, 1), (DimensionProperty.NONE,) * 3, ObservationType.DEFAULT, "grey"),
        ByteImage((6, 8, 5), (DimensionProperty.NONE,) * 3, ObservationType.GOAL_SIGNAL, "grid"),
    ],
    ActionSpec(1, ()),
)


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A built 3DBall, found without its extension."""
    folder = tmp_path_factory.mktemp("build")
    assert main(["build", "3DBall", str(folder)]) == 0
    return folder / "3DBall"


@contextlib.contextmanager
def unity_environment(build: Path, tmp_path: Path, **options: Any) -> Iterator[Any]:
    """ML-Agents' own client on a free port."""
    from mlagents_envs.environment import UnityEnvironment
    from mlagents_envs.exception import UnityWorkerInUseException

    logging.getLogger("mlagents_envs.environment").setLevel(logging.WARNING)
    for port in range(5405, 5505):
        with contextlib.suppress(UnityWorkerInUseException):
            env = UnityEnvironment(
                str(build), base_port=port, timeout_wait=60, log_folder=str(tmp_path), **options
            )
            break
    try:
        yield env
    finally:
        env.close()


def random_steps(count: int, spec: BehaviorSpec, rng: np.random.Generator) -> DecisionSteps:
    branches = spec.action_spec.discrete_branches
    return DecisionSteps(
        [rng.integers(0, 256, (count, *o.shape)).astype(np.float32) / 255 for o in spec.observation_specs],
        rng.normal(size=count).astype(np.float32),
        np.array([0, 127, 128, 2**31 - 1][:count], np.int32),
        [rng.random((count, size)) < 0.5 for size in branches] if branches else None,
        np.arange(count, dtype=np.int32) * 70000,
        rng.normal(size=count).astype(np.float32),
    )


def as_terminal(steps: DecisionSteps) -> TerminalSteps:
    interrupted = np.arange(len(steps)) % 2 == 0
    return TerminalSteps(
        steps.obs, steps.reward, interrupted, steps.agent_id, steps.group_id, steps.group_reward
    )


def assert_same_steps(mine: Any, theirs: Any) -> None:
    for a, b in zip(mine.obs, theirs.obs, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-7)
    for name in ("reward", "agent_id", "group_id", "group_reward"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)
    if isinstance(mine, TerminalSteps):
        np.testing.assert_array_equal(mine.interrupted, theirs.interrupted)
    elif mine.action_mask is not None:
        for a, b in zip(mine.action_mask, theirs.action_mask, strict=True):
            np.testing.assert_array_equal(a, b)


class TestWire:
    """What is written here must be what ML-Agents' own classes read, and the reverse."""

    @pytest.mark.parametrize("spec", [MIXED, PICTURE], ids=["mixed", "picture"])
    def test_steps_are_read_alike_by_mlagents_and_by_us(self, spec: BehaviorSpec) -> None:
        from mlagents_envs.communicator_objects.unity_message_pb2 import UnityMessageProto
        from mlagents_envs.rpc_utils import behavior_spec_from_proto, steps_from_proto

        rng = np.random.default_rng(0)
        decision, terminal = random_steps(4, spec, rng), as_terminal(random_steps(3, spec, rng))
        encoder = encode.BehaviorEncoder("B?team=1", spec)
        hello = encode.initialization("scene", "1", [encoder.brain_parameters()])
        data = messages.message(
            200, unity_output=encode.output({"B?team=1": encoder.encode(decision, terminal)}, hello)
        )
        theirs, ours = UnityMessageProto.FromString(data).unity_output, messages.parse(data).unity_output
        infos = theirs.rl_output.agentInfos["B?team=1"].value
        brain = theirs.rl_initialization_output.brain_parameters[0]
        assert behavior_spec_from_proto(brain, infos[0]) == spec
        found = decode.behavior_spec(
            ours.rl_initialization_output.brain_parameters[0],
            ours.rl_output.agentInfos["B?team=1"].value[0],
        )
        assert found == spec
        marked = [isinstance(sensor, ByteImage) for sensor in found.observation_specs]
        assert marked == (
            [False, True, False, True] if spec is PICTURE else [False, False]
        )  # grey is averaged
        mine = decode.BehaviorDecoder("B?team=1", spec).decode(ours.rl_output.agentInfos["B?team=1"].value)
        their_decision, their_terminal = steps_from_proto(infos, spec)
        assert_same_steps(mine[0], decision)
        assert_same_steps(mine[1], terminal)
        assert_same_steps(their_terminal, terminal)
        assert_same_steps(their_decision, decision)

    def test_pictures_of_bytes_travel_as_png(self) -> None:
        steps = random_steps(2, PICTURE, np.random.default_rng(1))
        exact = encode.BehaviorEncoder("B", PICTURE).encode(steps, TerminalSteps.empty(PICTURE))
        assert exact.count(b"\x89PNG") == 2 * (1 + 1 + 2)  # 5 channels take two pictures
        steps.obs[1][0, 0, 0, 0] = 0.5001
        assert encode.BehaviorEncoder("B", PICTURE).encode(steps, TerminalSteps.empty(PICTURE)).count(
            b"\x89PNG"
        ) == 2 * (1 + 2)
        plain = encode.BehaviorEncoder("B", PICTURE, png=False).encode(steps, TerminalSteps.empty(PICTURE))
        assert b"\x89PNG" not in plain
        unmarked = PICTURE._replace(
            observation_specs=[ObservationSpec(*s) for s in PICTURE.observation_specs]
        )
        floats = encode.BehaviorEncoder("B", unmarked).encode(steps, TerminalSteps.empty(unmarked))
        assert b"\x89PNG" not in floats

    @pytest.mark.parametrize("old", [False, True])
    def test_actions_are_read_alike_by_mlagents_and_by_us(self, old: bool) -> None:
        from mlagents_envs.communicator_objects.unity_message_pb2 import UnityMessageProto

        spec = MIXED if not old else BehaviorSpec(MIXED.observation_specs, ActionSpec(0, (3, 300)))
        continuous = np.array([[0.25, -1.0], [1.0, 0.5]], np.float32) if not old else None
        action = ActionTuple(continuous, np.array([[2, 299], [0, 128]], np.int32))
        rows = decode.ActionEncoder(spec, old).encode(action)
        data = messages.message(200, unity_input=decode.rl_input({"B": rows}, messages.STEP, b"side"))
        theirs = UnityMessageProto.FromString(data).unity_input.rl_input
        assert theirs.side_channel == b"side" and theirs.command == 0
        values = theirs.agent_actions["B"].value
        if old:
            assert [list(v.vector_actions_deprecated) for v in values] == [[2, 299], [0, 128]]
        else:
            assert [list(v.continuous_actions) for v in values] == [[0.25, -1.0], [1.0, 0.5]]
            assert [list(v.discrete_actions) for v in values] == [[2, 299], [0, 128]]
        got = encode.decode_actions(spec, messages.parse(data).unity_input.rl_input.agent_actions["B"].value)
        np.testing.assert_array_equal(got.discrete, action.discrete)
        np.testing.assert_array_equal(got.continuous, action.continuous)

    def test_padded_varints_hold_every_int32(self) -> None:
        # 300 = 0b10_0101100: low seven bits 0x2C, then 2 (protobuf's own example), padded with empty groups
        assert varint_columns(np.array([300])).tobytes() == b"\xac\x82\x80\x80\x00"
        assert varint_columns(np.array([2**31 - 1])).tobytes() == b"\xff\xff\xff\xff\x07"

    @pytest.mark.parametrize(
        ("break_it", "words"),
        [
            (lambda s: s.obs[0].__setitem__((1, 2), np.nan), "agent 127: its sensor obs_0 holds nan"),
            (lambda s: s.reward.__setitem__(0, np.inf), "agent 0: its reward holds inf"),
        ],
    )
    def test_numbers_that_are_not_finite_are_refused(self, break_it: Any, words: str) -> None:
        steps = random_steps(2, MIXED, np.random.default_rng(2))
        break_it(steps)
        rows = encode.BehaviorEncoder("B", MIXED).encode(steps, TerminalSteps.empty(MIXED))
        data = messages.message(200, unity_output=encode.output({"B": rows}))
        infos = messages.parse(data).unity_output.rl_output.agentInfos["B"].value
        with pytest.raises(decode.MalformedMessage, match=words):
            decode.BehaviorDecoder("B", MIXED).decode(infos)
        with pytest.raises(decode.MalformedMessage, match="obs_0 has shape"):
            other = BehaviorSpec([vector_spec(4), vector_spec(2)], MIXED.action_spec)
            decode.BehaviorDecoder("B", other).decode(infos)

    @pytest.mark.parametrize(
        "spoil", [lambda png: png[1:], lambda png: png[: len(png) // 2], lambda png: b"a\nb" * 60]
    )
    def test_broken_pictures_are_refused(self, spoil: Any) -> None:
        steps = random_steps(1, PICTURE, np.random.default_rng(2))
        rows = encode.BehaviorEncoder("B", PICTURE).encode(steps, TerminalSteps.empty(PICTURE))
        data = messages.message(200, unity_output=encode.output({"B": rows}))
        (info,) = messages.parse(data).unity_output.rl_output.agentInfos["B"].value
        png = next(o.compressed_data for o in info.observations if o.compression_type == messages.PNG)
        assert decode._pixels(png, []).ndim == 3
        with pytest.raises(decode.MalformedMessage, match="a picture of .* cannot be decoded"):
            decode._pixels(spoil(png), [])

    @pytest.mark.parametrize("first", [True, False])
    def test_agents_may_differ_in_what_they_compress(self, first: bool) -> None:
        from mlagents_envs.communicator_objects.unity_message_pb2 import UnityMessageProto
        from mlagents_envs.rpc_utils import steps_from_proto

        steps, none = random_steps(2, PICTURE, np.random.default_rng(2)), TerminalSteps.empty(PICTURE)
        rows = [encode.BehaviorEncoder("B", PICTURE, png).encode(steps, none) for png in (first, not first)]
        data = messages.message(200, unity_output=encode.output({"B": b"".join(rows)}))
        infos = messages.parse(data).unity_output.rl_output.agentInfos["B"].value
        theirs = UnityMessageProto.FromString(data).unity_output.rl_output.agentInfos["B"].value

        kinds = [info.observations[1].compression_type == messages.PNG for info in infos]
        assert kinds == [first] * 2 + [not first] * 2
        assert_same_steps(
            decode.BehaviorDecoder("B", PICTURE).decode(infos)[0], steps_from_proto(theirs, PICTURE)[0]
        )

    def test_a_narrow_picture_is_not_grey(self) -> None:
        shape = (3, 40, 1)
        marks = (DimensionProperty.NONE, *[DimensionProperty.TRANSLATIONAL_EQUIVARIANCE] * 2)
        spec = BehaviorSpec([ByteImage(shape, marks, ObservationType.DEFAULT, "bar")], ActionSpec(1, ()))
        steps = random_steps(2, spec, np.random.default_rng(2))
        steps.obs[0][:] = np.rint(steps.obs[0].clip(0, 1) * 255) / np.float32(255)
        rows = encode.BehaviorEncoder("B", spec).encode(steps, TerminalSteps.empty(spec))
        data = messages.message(200, unity_output=encode.output({"B": rows}))
        infos = messages.parse(data).unity_output.rl_output.agentInfos["B"].value
        assert infos[0].observations[0].compression_type == messages.PNG
        decision, _ = decode.BehaviorDecoder("B", spec).decode(infos)
        np.testing.assert_allclose(decision.obs[0], steps.obs[0], rtol=1e-6)

    def test_huge_but_finite_numbers_pass(self) -> None:
        steps = random_steps(2, MIXED, np.random.default_rng(2))
        steps.obs[0][:] = 3e38  # their sum overflows float32
        rows = encode.BehaviorEncoder("B", MIXED).encode(steps, TerminalSteps.empty(MIXED))
        data = messages.message(200, unity_output=encode.output({"B": rows}))
        infos = messages.parse(data).unity_output.rl_output.agentInfos["B"].value
        assert decode.BehaviorDecoder("B", MIXED).decode(infos)[0].obs[0].max() == np.float32(3e38)


class TestOtherClients:
    """Clients that know nothing of this project."""

    def test_unity_environment_gets_the_embedded_trajectory(self, build: Path, tmp_path: Path) -> None:
        from mlagents_envs.side_channel.engine_configuration_channel import EngineConfigurationChannel
        from mlagents_envs.side_channel.environment_parameters_channel import EnvironmentParametersChannel

        parameters, engine = EnvironmentParametersChannel(), EngineConfigurationChannel()
        parameters.set_float_parameter("mass", 3.0)
        parameters.set_float_parameter("no_such_thing", 1.0)
        engine.set_configuration_parameters(time_scale=20.0, width=84, height=84, quality_level=1)
        scene = make_scene("3DBall", seed=11, num_areas=2, mass=3.0)
        with unity_environment(
            build, tmp_path, seed=11, num_areas=2, no_graphics=True, side_channels=[parameters, engine]
        ) as env:
            env.reset()
            scene.reset()
            name = "3DBall?team=0"
            assert dict(env.behavior_specs) == dict(scene.behavior_specs)
            rng = np.random.default_rng(0)
            for step in range(150):
                for mine, theirs in zip(scene.get_steps(name), env.get_steps(name), strict=True):
                    assert_same_steps(mine, theirs)
                count = len(env.get_steps(name)[0])
                action = ActionTuple(rng.uniform(-1, 1, (count, 2)).astype(np.float32))
                for either in (env, scene):
                    either.set_actions(name, action)
                    either.reset() if step == 80 else either.step()
            assert env.academy_capabilities.multiAgentGroups
        log = (tmp_path / "Player-0.log").read_text()
        assert "environment parameter mass = 3" in log
        assert "no_such_thing = 1 is ignored" in log and "time scale 20" in log
        assert "the trainer closed" in log

    def test_one_area_asked_for_is_the_scene_as_in_unity(self, build: Path, tmp_path: Path) -> None:
        with unity_environment(build, tmp_path) as env:  # its default is num_areas=1
            env.reset()
            assert len(env.get_steps("3DBall?team=0")[0]) == 12

    def test_gym_wrapper_steps_a_single_agent(self, build: Path, tmp_path: Path) -> None:
        """gym_unity.envs.UnityToGymWrapper takes environments of one agent."""
        wrappers = pytest.importorskip("gym_unity.envs")
        with unity_environment(build, tmp_path, additional_args=["--num-areas", "1"]) as env:
            gym = wrappers.UnityToGymWrapper(env)
            assert gym.reset().shape == (8,)
            for _ in range(30):
                obs, reward, done, _ = gym.step(gym.action_space.sample())
                assert obs.shape == (8,) and reward in (np.float32(0.1), -1)
                if done:
                    gym.reset()

    def test_torchrl_rolls_3dball_out(self, build: Path) -> None:
        """As the documentation of UnityMLAgentsEnv and Stack shows."""
        from torchrl.envs import Stack, TransformedEnv, UnityMLAgentsEnv

        env = None
        from mlagents_envs.exception import UnityWorkerInUseException

        for port in range(5505, 5605):
            with contextlib.suppress(UnityWorkerInUseException):
                env = UnityMLAgentsEnv(str(build), base_port=port, timeout_wait=60, no_graphics=True)
                break
        assert env is not None
        try:
            agents = [("group_0", f"agent_{i}") for i in range(12)]
            stacked = TransformedEnv(
                env,
                Stack(
                    in_keys=agents,
                    out_key=("group_0", "agents"),
                    in_key_inv=("group_0", "agents"),
                    out_keys_inv=agents,
                ),
            )
            rollout = stacked.rollout(20, break_when_any_done=False)
            obs = rollout["group_0", "agents", "VectorSensor_size8"]
            assert obs.shape == (20, 12, 8) and bool(obs.isfinite().all()) and float(obs.abs().sum()) > 0
            # The ball rests on the plate at first: each decision is rewarded with 0.1.
            assert float(rollout["next", "group_0", "agents", "group_reward"].abs().sum()) == 0
            assert float(rollout["next", "group_0", "agents", "reward"].sum()) > 1
        finally:
            env.close()


@pytest.mark.parametrize("scene", BUILT_IN)
def test_every_scene_passes_through_the_wire_unchanged(scene: str) -> None:
    """The player's bytes, decoded, are the embedded scene's steps, to the bit; actions come back as sent."""
    areas = 1 if scene in ("SoccerTwos", "GridFoodCollector", "Pyramids") else None
    mine = make_scene(scene, seed=5, **({"num_areas": areas} if areas else {}))
    player = Player(env_function(scene, areas), scene)
    answers = messages.parse(messages.message(200, unity_input=decode.initialization(5, 1, "0.28.0")))
    player._open(answers.unity_input.rl_initialization_input)
    decoders: dict[str, decode.BehaviorDecoder] = {}
    mine.reset()
    data = decode.rl_input({}, messages.RESET, b"")
    rng = np.random.default_rng(0)
    for _ in range(12):
        parsed = messages.parse(messages.message(200, unity_input=data)).unity_input.rl_input
        output = messages.parse(messages.message(200, unity_output=player.advance(parsed))).unity_output
        infos = output.rl_output.agentInfos
        for brain in output.rl_initialization_output.brain_parameters:
            spec = decode.behavior_spec(brain, infos[brain.brain_name].value[0])
            assert spec == mine.behavior_specs[brain.brain_name]
            decoders[brain.brain_name] = decode.BehaviorDecoder(brain.brain_name, spec)
        actions = {}
        for name, spec in mine.behavior_specs.items():
            expected = mine.get_steps(name)
            if name not in decoders:
                assert not len(expected[0]) and not len(expected[1])
                continue
            got = decoders[name].decode(infos[name].value if name in infos else ())
            for a, b in zip(got, expected, strict=True):
                assert_same_steps(a, b)
            if len(expected[0]):
                action = random_action(spec, len(expected[0]), rng)
                mine.set_actions(name, action)
                actions[name] = decode.ActionEncoder(spec).encode(action)
        mine.step()
        data = decode.rl_input(actions, messages.STEP, b"")
    player.env.close()


def random_action(spec: BehaviorSpec, count: int, rng: np.random.Generator) -> ActionTuple:
    size, branches = spec.action_spec.continuous_size, spec.action_spec.discrete_branches
    action = ActionTuple()
    if size:
        action.add_continuous(rng.uniform(-1, 1, (count, size)).astype(np.float32))
    if branches:
        action.add_discrete(np.stack([rng.integers(0, n, count) for n in branches], 1).astype(np.int32))
    return action


def a_factory(seed: int, size: int = 1) -> Any:
    """Stand for a user's factory."""
    if size > 8:
        raise RuntimeError("too big")
    return make_scene("3DBall", seed=seed, num_areas=size)


class TestCommand:
    """Options of mappo-player."""

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["Nowhere"], "there is no scene 'Nowhere'; choices: 3DBall"),
            (["3DBall", "--param", "mass=heavy"], "NAME=NUMBER"),
            (["3DBall", "--mlagents-port", "many"], "--mlagents-port: 'many' is not a whole number"),
            (
                ["3DBall", "--mlagents-prt", "5005"],
                "--mlagents-prt is not an option of mappo-player (did you",
            ),
            (
                ["3DBall", "--mlagents-port", "5005", "--mlagents-port", "5006"],
                "is given twice, 5005 and 5006",
            ),
            (["3DBall", "Basic"], "'Basic' behind the scene '3DBall' is no option: one scene is served"),
            (["3DBall", "mass=2"], "parameters are given as --param mass=2"),
            (["3dball"], "there is no scene '3dball' (did you mean 3DBall?); choices"),
            (["os:gotcwd"], "os has no function 'gotcwd' (did you mean getcwd"),
            (["3DBall", "-logFile", "/dev/full"], "-logFile /dev/full cannot be written: No space left on"),
            (
                ["build", "3DBall", "never", "--mlagents-port", "7"],
                "--mlagents-port 7 has no effect on a build",
            ),
            (["build", "3DBall", "never", "more"], "build takes a scene and a folder, not more"),
            (
                ["3DBall", "--mlagents-port", "70000"],
                "--mlagents-port 70000 is out of range: it must be from 1 to",
            ),
            (["3DBall", "--num-areas", "0"], "--num-areas 0 is out of range: it must be at least 1"),
            (["build", "3DBall", "never", "--num-areas", "0"], "--num-areas 0 is out of range"),
            (["build", "3DBall", "never", "--param", "mass=heavy"], "NAME=NUMBER"),
            (["build", "3DBall", "never", "--param", "nosuch=3"], "nosuch"),
            (["build", "3DBall"], "needs a scene and a folder"),
            (["build", "Nowhere", "folder"], "there is no scene 'Nowhere'"),
            ([], "SCENE"),
        ],
    )
    def test_mistakes_are_named(self, arguments: list[str], words: str) -> None:
        with pytest.raises(ConfigError, match=re.escape(words)):
            main(arguments)

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (
                ["3DBall", "--param", "foo=1"],
                "scene 3DBall has no parameter 'foo'; choices: gravity, mass, scale",
            ),
            (
                ["3DBall", "--param", "mass=-1"],
                "parameter mass=-1 of scene 3DBall is out of range: it must be > 0",
            ),
            (["3DBall", "--param", "seed=3"], "--param seed: the seed is the trainer's to choose"),
            (["3DBall", "--param", "num_areas=0"], "num_areas=0 must be a whole number >= 1"),
            (["3DBall", "--param", "num_threads=1.5"], "num_threads=1.5 must be a whole number >= 1"),
            (
                ["test_player:a_factory", "--param", "foo=1"],
                "unexpected keyword argument 'foo'; it is a_factory(seed",
            ),
        ],
    )
    def test_options_are_checked_before_the_trainer_is_called(
        self, arguments: list[str], words: str, monkeypatch: pytest.MonkeyPatch, capsys: Any
    ) -> None:
        monkeypatch.setattr(
            "mappo_unity.protocol.serve.serve", lambda *_: pytest.fail("it called the trainer")
        )
        assert player_main(arguments) == 2
        printed = capsys.readouterr().err
        assert words in printed and printed.count("\n") == 1

    def test_a_factory_that_raises_is_told_to_the_trainer(self) -> None:
        make_env = env_function("test_player:a_factory", params={"size": 9})
        with pytest.raises(ConfigError, match="^test_player:a_factory raised RuntimeError: too big$"):
            make_env(0, None)

        class Channel:
            def __init__(self) -> None:
                self.sent: list[bytes] = []

            def __call__(self, data: bytes, timeout: float = 0) -> bytes:
                self.sent.append(data)
                start = decode.initialization(5, 1, "0.28.0")
                return messages.message(200, unity_input=start)

        lines: list[str] = []
        channel = Channel()
        assert play(Player(make_env, "a_factory", lines.append), channel, lines.append) == 2
        goodbye = messages.parse(channel.sent[-1]).header
        assert goodbye.message == "test_player:a_factory raised RuntimeError: too big"
        assert goodbye.status == messages.STATUS_QUIT
        assert "in a_factory" in lines[-1] and "player.py" not in lines[-1].replace(__file__, "")

    def test_whole_numbers_stay_whole(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("mappo_unity.protocol.serve.serve", lambda *_: 0)
        assert main(["3DBall", "--param", "num_threads=2", "--param", "mass=2.5"]) == 0
        assert main(["test_player:a_factory", "--param", "size=3"]) == 0

    def test_a_folder_that_cannot_be_written_is_named(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(ConfigError, match="cannot be written: .*file is a file, not a folder"):
            main(["build", "3DBall", str(tmp_path / "file" / "deeper")])

    def test_arguments_of_unity_players_are_let_through(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("mappo_unity.protocol.serve.serve", lambda player, port, log: port)
        assert main(["3DBall", "-nographics", "-batchmode", "--mlagents-port", "7", "--level", "3"]) == 7
        assert main(["3DBall", "-headless", "-l", "3", "-log", "x", "-n", "--mlagents-port", "7"]) == 7

    def test_its_own_switches_are_known_in_every_form(self) -> None:
        for switch in (["-logFile", "here"], ["-logfile=here"]):
            known, ignored = player_options.parse(["3DBall", "-force-vulkan", *switch, "--param=mass=2"])
            assert (known.log_file, known.params, ignored) == ("here", {"mass": 2}, ["-force-vulkan"])
        assert "--help" in player_options.help_text()

    def test_a_player_says_that_it_waits_and_what_to_type(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("mappo_unity.protocol.serve.QUIET_S", 0.05)
        monkeypatch.setattr("mappo_unity.protocol.serve.CONNECT_TIMEOUT_S", 0.2)
        with socket.socket() as other:  # nobody listens on its port
            other.bind(("127.0.0.1", 0))
            port = other.getsockname()[1]
            lines: list[str] = []
            assert serve(Player(env_function("Basic"), "Basic", lines.append), port, lines.append) == 1
            waits, gives_up = lines
            assert f"waiting up to 0.2 s for a trainer on port {port} of this machine" in waits
            assert waits.endswith(f"mappo-train env=Basic env.backend=editor env.port={port}")
            assert f"no trainer listened on port {port}" in gives_up

            other.listen()
            lines.clear()
            assert serve(Player(env_function("Basic"), "a:Game", lines.append), port, lines.append) == 1
            assert "mappo-train env=unity env.name=Game env.backend=editor" in lines[0]
            assert f"what listens on port {port} of this machine did not answer as an ML-Agents" in lines[1]

    def test_a_log_on_a_disk_that_fills_up_ends_no_play(self, tmp_path: Path) -> None:
        log = PlayerLog(str(tmp_path / "log"))
        log("first")
        log._file.close()
        log._file = open("/dev/full", "wb", buffering=0)
        log("lost")
        log._file.close()
        assert (tmp_path / "log").read_text().endswith(" first\n")
