"""Serve a scene as if it were a built Unity player.

It is the gRPC client's side of the ML-Agents protocol (API 1.5.0) on a port of this machine, until the
trainer closes or goes away. The order of messages is that of RpcCommunicator.cs of com.unity.ml-agents. A
player must not import torch.
"""

from __future__ import annotations

import re
import socket
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.protobuf import install

install()

import grpc  # noqa: E402
from mlagents_envs.base_env import BaseEnv  # noqa: E402

from mappo_unity import __version__  # noqa: E402
from mappo_unity.config.option_table import did_you_mean  # noqa: E402
from mappo_unity.config.parameters.samplers import Sampler, Value  # noqa: E402
from mappo_unity.config.parameters.values import show_parameter  # noqa: E402
from mappo_unity.protocol import encode, messages, side_channels  # noqa: E402
from mappo_unity.protocol.messages import STATUS_OK, STATUS_QUIT  # noqa: E402
from mappo_unity.protocol.ports import EDITOR_PORT  # noqa: E402
from mappo_unity.scenes.contract.statistics import pop_statistics  # noqa: E402

CONNECT_TIMEOUT_S = 60.0
"""How long a player looks for its trainer."""
RETRIES = (("grpc.initial_reconnect_backoff_ms", 500), ("grpc.max_reconnect_backoff_ms", 1000))
"""How often it looks: gRPC's own pauses grow so long that it may miss a trainer."""
QUIET_S = 1.0
"""After so much of it the player says that it waits: a trainer that starts players listens already."""

MakeEnv = Callable[[int, "int | None"], BaseEnv]
Log = Callable[[str], None]


class PlayerError(RuntimeError):
    """The trainer asked for something that cannot be done."""


def env_function(scene: str, num_areas: int | None = None, params: dict[str, float] | None = None) -> MakeEnv:
    """Return the function (seed, number of areas or None) -> BaseEnv of a scene or a factory.

    `num_areas` and `params` given here win over what the trainer says.
    Raises ConfigError: there is no such scene, or it does not take them.
    """
    fixed: dict[str, Any] = dict(params or {}) | ({} if num_areas is None else {"num_areas": num_areas})
    if "seed" in fixed:
        raise ConfigError("--param seed: the seed is the trainer's to choose")

    if re.fullmatch(r"[\w.]+:\w+", scene):
        from mappo_unity.scenes.factory import call_factory, check_call, load_factory

        factory = load_factory(scene, scene)
        check_call(factory, scene, fixed)
        # the trainer's number of areas is left out: a factory need not take it
        return lambda seed, areas: call_factory(factory, scene, seed, fixed)
    from mappo_unity.scenes import make_scene, scene_names

    if scene not in scene_names():
        hint = did_you_mean(scene, scene_names())
        choices = ", ".join(scene_names())
        raise ConfigError(
            f"there is no scene {scene!r}{hint}; choices: {choices}, or package.module:function"
        )
    make_scene(scene, **{"num_areas": 1} | fixed).close()  # refuses what it does not take

    return lambda seed, areas: make_scene(
        scene, seed=seed, **({} if areas is None else {"num_areas": areas}) | fixed
    )


def serve(player: Player, port: int, log: Log) -> int:
    """Connect to the trainer on a port of this machine and play until it closes; return the exit code."""
    channel = grpc.insecure_channel(f"localhost:{port}", options=(*messages.OPTIONS, *RETRIES))
    if not _connect(channel, player.scene, port, log):
        channel.close()
        return 1

    try:
        return play(player, channel.unary_unary(messages.METHOD), log)
    finally:
        channel.close()


def _connect(channel: grpc.Channel, scene: str, port: int, log: Log) -> bool:
    """Wait for the trainer, and say so if that takes a while; tell whether it came."""
    ready = grpc.channel_ready_future(channel)

    try:
        ready.result(timeout=QUIET_S)
        return True
    except grpc.FutureTimeoutError:
        log(
            f"waiting up to {CONNECT_TIMEOUT_S:g} s for a trainer on port {port} of this machine "
            f"(localhost); start one in another terminal, for example: {_trainer(scene, port)}"
        )

    try:
        ready.result(timeout=CONNECT_TIMEOUT_S - QUIET_S)
        return True
    except grpc.FutureTimeoutError:
        log(f"{_who_listens(port)} within {CONNECT_TIMEOUT_S:g} s; --mlagents-port N looks on another port")
        return False


def _trainer(scene: str, port: int) -> str:
    """Return the command that trains on this player."""
    env = f"env={scene}" if ":" not in scene else f"env=unity env.name={scene.rpartition(':')[2]}"
    return f"mappo-train {env} env.backend=editor" + (f" env.port={port}" if port != EDITOR_PORT else "")


def _who_listens(port: int) -> str:
    try:
        socket.create_connection(("localhost", port), timeout=1).close()
    except OSError:
        return f"no trainer listened on port {port} of this machine"
    return f"what listens on port {port} of this machine did not answer as an ML-Agents trainer does"


def play(player: Player, exchange: Callable[..., bytes], log: Log) -> int:
    """Play until the trainer closes, and log how that ended; return the exit code."""
    try:
        player.play(exchange)
        log("the trainer closed")
        return 0
    except grpc.RpcError as error:
        log(f"the connection to the trainer is gone: {error.details() or error.code()}")
        return 1
    except ConfigError as mistake:
        log("\n".join([str(mistake), *mistake.details]))
        _say_goodbye(exchange, str(mistake))
        return 2
    except Exception as error:
        log(traceback.format_exc())
        _say_goodbye(exchange, f"{type(error).__name__}: {error}")
        return 1


@dataclass
class Player:
    """Answer a trainer's messages with an environment's steps.

    `make_env` is called with the seed and, where the trainer asks for several areas, their number.
    """

    make_env: MakeEnv
    scene: str
    log: Log = lambda line: None
    png: bool = True
    env: BaseEnv = field(init=False)
    encoders: dict[str, encode.BehaviorEncoder] = field(init=False, default_factory=dict)

    def play(self, exchange: Callable[[bytes], bytes]) -> None:
        """Shake hands, then advance the environment message by message until the trainer quits.

        Raises:
            PlayerError: the trainer speaks another version, or its actions do not fit.
        """
        hello = encode.initialization(self.scene, __version__)
        answer = messages.parse(
            exchange(messages.message(STATUS_OK, unity_output=messages.delimited(2, hello)))
        )
        if answer.header.status != STATUS_OK:
            return

        self._open(answer.unity_input.rl_initialization_input)

        # An empty message: the trainer answers it with its first command.
        answer = messages.parse(exchange(messages.message(STATUS_OK)))

        try:
            while answer.header.status == STATUS_OK and answer.HasField("unity_input"):
                output = self.advance(answer.unity_input.rl_input)
                answer = messages.parse(exchange(messages.message(STATUS_OK, unity_output=output)))
        finally:
            self.env.close()

    def advance(self, rl_input: Any) -> bytes:
        """Apply a trainer's input to the environment; return the UnityOutputProto of its next steps."""
        if rl_input.side_channel:
            self._read_side_channels(rl_input.side_channel)

        if rl_input.command == messages.RESET:
            self.env.reset()
        else:
            for name, rows in rl_input.agent_actions.items():
                self._act(name, rows.value)
            self.env.step()

        return self._output()

    def _open(self, parameters: Any) -> None:
        version = parameters.communication_version
        if version.split(".")[0] != messages.API_VERSION.split(".")[0]:
            raise PlayerError(f"the trainer speaks protocol {version!r}, this player {messages.API_VERSION}")

        # One area is what clients send when nobody chose: then the scene has as many as in Unity.
        areas = parameters.num_areas if parameters.num_areas > 1 else None
        # The trainer's seed may be negative, numpy's may not.
        self.env = self.make_env(parameters.seed & 0x7FFFFFFF, areas)

        self.log(
            f"connected to mlagents_envs {parameters.package_version}, protocol {version}; "
            f"seed {parameters.seed}, areas {areas or 'as in Unity'}"
        )

    def _act(self, name: str, values: Sequence[Any]) -> None:
        if name not in self.encoders:
            raise PlayerError(f"actions for behavior {name!r}, which no agent has shown")

        asked = len(self.env.get_steps(name)[0])
        if len(values) != asked:
            raise PlayerError(
                f"{len(values)} actions for {asked} agents of {name!r} that requested a decision"
            )

        if asked:
            self.env.set_actions(name, encode.decode_actions(self.encoders[name].spec, values))

    def _output(self) -> bytes:
        agent_infos, came_up = {}, []

        specs = self.env.behavior_specs
        for name in specs:
            decision, terminal = self.env.get_steps(name)
            if not len(decision) and not len(terminal):
                continue

            # A trainer learns of a behavior only together with its first agents.
            if name not in self.encoders:
                self.encoders[name] = encode.BehaviorEncoder(name, specs[name], self.png)
                came_up.append(self.encoders[name].brain_parameters())

            agent_infos[name] = self.encoders[name].encode(decision, terminal)

        hello = encode.initialization(self.scene, __version__, came_up) if came_up else None
        statistics = side_channels.statistics_messages(pop_statistics(self.env))
        return encode.output(agent_infos, hello, statistics)

    def _read_side_channels(self, data: bytes) -> None:
        for channel, content in side_channels.split(data):
            if channel == side_channels.PARAMETERS:
                self._set_parameter(*side_channels.read_parameter(content))
            elif channel == side_channels.ENGINE:
                self.log(f"without effect here: {side_channels.read_engine_setting(content)}")
            elif channel != side_channels.ANALYTICS:
                self.log(f"a message on side channel {channel}, which this player does not know")

    def _set_parameter(self, name: str, value: Value) -> None:
        from mappo_unity.scenes.core.scene import Scene

        setter = getattr(self.env, "set_parameter", None)
        shown = show_parameter(value)
        try:
            if setter is None:
                raise ConfigError("the environment takes no parameters")
            if isinstance(value, Sampler) and not isinstance(self.env, Scene):
                raise ConfigError("only scenes draw from samplers; this environment takes numbers")
            setter(name, value)
            self.log(f"environment parameter {name} = {shown}")
        except ConfigError as error:  # Unity accepts any name, too
            self.log(f"environment parameter {name} = {shown} is ignored: {error}")


def _say_goodbye(exchange: Callable[..., bytes], text: str) -> None:
    try:
        exchange(messages.message(STATUS_QUIT, text=text), timeout=5)
    except grpc.RpcError:
        pass  # nobody is there to hear it
