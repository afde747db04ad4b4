"""One running player as a BaseEnv, from the trainer's side.

It differs from mlagents_envs.environment.UnityEnvironment in that it listens on loopback only, takes a port
that the system gives, decodes without a loop over numbers, refuses numbers that are not finite, and says what
failed and where the log is, or what a player without one printed. A failure raises `PlayerFailure`, after
which the player is gone; `RestartingPlayer` starts another.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from typing import Any

from mlagents_envs import __version__ as MLAGENTS_VERSION
from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorMapping, DecisionSteps, TerminalSteps
from mlagents_envs.exception import UnityActionException, UnityEnvironmentException, UnityException
from mlagents_envs.side_channel import SideChannel

from mappo_unity.config.parameters.samplers import Value
from mappo_unity.protocol import decode, messages
from mappo_unity.protocol.decode import ActionEncoder, BehaviorDecoder, MalformedMessage, behavior_spec
from mappo_unity.protocol.messages import STATUS_OK
from mappo_unity.protocol.player_failures import (
    PlayerFailure,
    ProtocolMismatch,
    never_answered,
    never_connected,
)
from mappo_unity.protocol.player_options import PlayerOptions
from mappo_unity.protocol.process import PlayerProcess
from mappo_unity.protocol.server import Link, LinkTimeout
from mappo_unity.protocol.side_channels import TrainerChannels
from mappo_unity.scenes.contract.images import sends_channels_last
from mappo_unity.scenes.contract.statistics import Statistics

CLOSE_S = 5.0  # how long a player may take to leave before it is killed

logger = logging.getLogger(__name__)


class UnityPlayer(BaseEnv):
    """Start a player (or wait for the Editor), connect, and step it.

    The constructor only starts it; `connect` waits for it, so several players start side by side. A step may
    be split likewise: `send_step` hands the actions over, `receive` waits for the result.

    Args:
        options: how to start it.
        seed: of the player's random numbers.
        side_channels: further ones.
    """

    def __init__(
        self, options: PlayerOptions, seed: int = 0, side_channels: list[SideChannel] | None = None
    ) -> None:
        self.options, self.seed = options, seed

        self._channels = TrainerChannels(options.parameters, options.engine, side_channels or [], seed)

        self._decoders: dict[str, BehaviorDecoder] = {}
        self._encoders: dict[str, ActionEncoder] = {}
        self._steps: dict[str, tuple[DecisionSteps, TerminalSteps]] = {}
        self._actions: dict[str, ActionTuple] = {}
        self._open, self._was_reset = True, False
        self.handshake: Any = None
        """The player's UnityRLInitializationOutputProto, once connected."""
        self.process: PlayerProcess | None = None
        """The player's process; None for the Editor."""

        # The player is started after this: its command line names the port that is listened on.
        self._link = Link(options.port)
        if options.executable is not None:
            try:
                output = options.log_file.with_suffix(".out")
                self.process = PlayerProcess(
                    options.executable, options.command_line(self._link.port), output
                )
            except BaseException:
                self._link.close()
                raise

    # ---- connection ---------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Wait for the player and shake hands.

        Raises:
            PlayerFailure: it did not come, left, or sent nonsense.
            ProtocolMismatch: it speaks another version; also a ConfigError.
        """
        if self.process is None:
            wait = "waiting %g s for the Unity Editor on port %d: press Play"
            logger.warning(wait, self.options.timeout_s, self._link.port)

        output = self._receive()
        self.handshake = output.rl_initialization_output
        self._check_version()
        self._reply(decode.initialization(self.seed, self.options.num_areas, MLAGENTS_VERSION))
        self._receive()  # the player's empty message: it waits for the first command

    def send_step(self) -> None:
        """Hand the actions over and let the player play; agents without an action act with zeros."""
        # as in mlagents_envs, a first step is a reset
        if not self._was_reset:
            return self.send_reset()

        actions = {}
        for name, (decision, _) in self._steps.items():
            if len(decision):
                action = self._actions.get(name)
                if action is None:
                    action = self._decoders[name].spec.action_spec.empty_action(len(decision))
                actions[name] = self._encoders[name].encode(action)

        self._send(actions, messages.STEP)

    def send_reset(self) -> None:
        """Tell the player to reset its scene."""
        self._was_reset = True
        self._send({}, messages.RESET)

    def receive(self) -> None:
        """Wait for the result of `send_step` or `send_reset`.

        Raises:
            PlayerFailure: the player crashed, hung, left or sent nonsense.
        """
        output = self._receive()
        try:
            # first: a behavior is described in the message that brings its first agents
            self._add_behaviors(output)
            infos = output.rl_output.agentInfos
            self._steps = {
                name: decoder.decode(infos[name].value if name in infos else ())
                for name, decoder in self._decoders.items()
            }
            if output.rl_output.side_channel:
                self._channels.process_side_channel_message(output.rl_output.side_channel)
        except (MalformedMessage, UnityException, struct.error, ValueError, IndexError) as error:
            raise self._failure(f"sent a malformed message: {error}") from error

    def set_parameter(self, name: str, value: Value) -> None:
        """Set an environment parameter of the player, with its next step."""
        self._channels.parameters.send(name, value, self.seed)

    def set_time_scale(self, scale: float) -> None:
        """Let the player run so much faster than real time, from the next step on."""
        self._channels.engine.set_configuration_parameters(time_scale=scale)

    def pop_statistics(self) -> Statistics:
        """Return what the game reported of itself (StatsRecorder) since the last call."""
        return self._channels.pop_statistics()

    # ---- BaseEnv ------------------------------------------------------------------------------------------

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """Return the specs of the behaviors that have shown up so far."""
        return BehaviorMapping({name: decoder.spec for name, decoder in self._decoders.items()})

    def reset(self) -> None:
        """Reset the scene; the next steps are its first."""
        self.send_reset()
        self.receive()

    def step(self) -> None:
        """Advance until some agent reports."""
        self.send_step()
        self.receive()

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the decision and terminal steps of the last result."""
        self._known(behavior_name)
        return self._steps[behavior_name]

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Set the actions of all agents in the last decision steps, in their order."""
        spec = self._known(behavior_name).spec.action_spec
        count = len(self._steps[behavior_name][0])
        self._actions[behavior_name] = spec._validate_action(action, count, behavior_name)

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Set the action of one agent in the last decision steps."""
        spec = self._known(behavior_name).spec.action_spec
        decision = self._steps[behavior_name][0]
        if agent_id not in decision.agent_id_to_index:
            raise IndexError(f"agent {agent_id} of {behavior_name} did not request a decision")

        row = decision.agent_id_to_index[agent_id]
        action = spec._validate_action(action, 1, behavior_name)
        stored = self._actions.setdefault(behavior_name, spec.empty_action(len(decision)))
        stored.continuous[row], stored.discrete[row] = action.continuous[0], action.discrete[0]

    def close(self) -> None:
        """Tell the player to leave, see that it does, and free the port; again is allowed."""
        self._end(CLOSE_S)

    # ---- below --------------------------------------------------------------------------------------------

    def _send(self, actions: dict[str, bytes], command: int) -> None:
        if not self._open:
            raise UnityEnvironmentException(f"{self._name()} is closed")
        channels = bytes(self._channels.generate_side_channel_messages())
        self._reply(decode.rl_input(actions, command, channels))
        self._actions.clear()

    def _reply(self, unity_input: bytes) -> None:
        self._link.reply(messages.message(STATUS_OK, unity_input=unity_input))

    def _receive(self) -> Any:
        from google.protobuf.message import DecodeError

        try:
            data = self._link.receive(self.options.timeout_s, self._check_alive)
        except LinkTimeout as error:
            raise self._failure(self._silence()) from error

        try:
            answer = messages.parse(data)
        except DecodeError as error:
            raise self._failure(f"sent a malformed message of {len(data)} bytes ({error})") from error

        if answer.header.status != STATUS_OK:
            reason = answer.header.message
            raise self._failure("closed the connection" + (f": {reason}" if reason else ""))
        return answer.unity_output

    def _check_version(self) -> None:
        version = self.handshake.communication_version
        if version.split(".")[0] == messages.API_VERSION.split(".")[0]:
            return

        # the message first: it quotes the player's log, which is read while the player still stands
        error = ProtocolMismatch(
            f"{self._name()} speaks version {version!r} of the ML-Agents protocol (package "
            f"{self.handshake.package_version or 'unknown'}), this trainer {messages.API_VERSION}; the "
            f"first numbers must agree: build it with com.unity.ml-agents 2.0 or later{self._log_hint()}"
        )
        self.close()
        raise error

    def _check_alive(self) -> None:
        how = self.process.ended() if self.process is not None else None
        if how is not None:
            when = "while it started" if self.handshake is None else "during the training run"
            raise self._failure(f"ended {when}: {how}")

    def _silence(self) -> str:
        if self.handshake is None:
            return never_connected(self.options, self._link.port)
        return never_answered(self.options.timeout_s, bool(self._decoders))

    def _add_behaviors(self, output: Any) -> None:
        for brain in output.rl_initialization_output.brain_parameters:
            infos = output.rl_output.agentInfos
            name = brain.brain_name
            if name in self._decoders or name not in infos or not infos[name].value:
                continue

            # Which sensors there are only an agent's message says; hence the wait for one.
            spec = behavior_spec(brain, infos[name].value[0], sends_channels_last(self.handshake))
            self._decoders[name] = BehaviorDecoder(name, spec)
            self._encoders[name] = ActionEncoder(spec, old=not self.handshake.capabilities.hybridActions)

    def _known(self, name: str) -> BehaviorDecoder:
        if name not in self._decoders:
            raise UnityActionException(f"there is no behavior {name!r}; there are {list(self._decoders)}")
        return self._decoders[name]

    def _failure(self, what: str) -> PlayerFailure:
        """End the player and return the error that says why."""
        error = PlayerFailure(f"{self._name()} {what}{self._log_hint()}")
        self._end(0.0)
        return error

    def _end(self, patience_s: float) -> None:
        if not self._open:
            return
        self._open = False
        self._link.say_quit()

        if self.process is not None:
            if patience_s:
                self.process.wait(patience_s)
            self.process.kill()

        self._link.close()

    def _name(self) -> str:
        return "the Unity Editor" if self.process is None else f"player {self.process.executable.name}"

    def _log_hint(self) -> str:
        if self.process is None:
            return ""
        return f"; {self.process.traces(self.options.own_log_file or self.options.log_file)}"


MakePlayer = Callable[[int], UnityPlayer]
