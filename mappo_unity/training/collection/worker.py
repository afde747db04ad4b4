"""A worker: an environment, a collector and a policy; it knows no transport, and not how many there are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ExplorationType

from mappo_unity.config.parameters.samplers import Value
from mappo_unity.config.schema import Backend, Config
from mappo_unity.envs.backends import make_env_function
from mappo_unity.envs.following import followed
from mappo_unity.envs.replay import make_replay_function
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.learning.networks.actor_critic import UnityActor
from mappo_unity.learning.networks.distributions import CONTINUOUS_LIMIT
from mappo_unity.learning.networks.encoders import running_norms
from mappo_unity.learning.networks.joint_policy import JointPolicy
from mappo_unity.protocol.restarting_player import SEED_STRIDE
from mappo_unity.runs.checkpoint import to_arrays
from mappo_unity.runs.folder import PLAYERS
from mappo_unity.runs.rng import get_rng_state, set_rng_state
from mappo_unity.training.collection.batches import Batch, BatchCollector
from mappo_unity.training.collection.description import Description, describe
from mappo_unity.training.collection.lineups import Lineup, Network, fits_teams, line_up

WORKER_STRIDE = 1_000_003
"""Worker n of several starts from the run's seed plus n times this (modulo 2^31)."""

Weights = Mapping[str, Mapping[str, Tensor]]
"""An actor's `state_dict` by policy name, and `MOVES`."""
MOVES = "moving_norms"
"""The entry of an actor's weights that says whether its statistics move with each round."""


class Message(NamedTuple):
    """What `Worker.collect` returns."""

    batch: Batch
    state: dict[str, Any] | None  # of the worker behind the batch, where it was asked for


class Worker:
    """Collect batches from an environment of its own.

    Args:
        cfg: the worker's options, see `worker_config`.
        env: the environment, open.
        device: of the policy.
        number: of the worker.
    """

    def __init__(self, cfg: Config, env: UnityEnv, device: str = "cpu", number: int = 0) -> None:
        self.env, self._cfg, self._device, self._number = env, cfg, device, number
        self._policy: JointPolicy | None = None
        self._collector: Collector | None = None
        self._batches: BatchCollector | None = None
        self._memories: dict[str, Tensor] | None = None  # of a state that was loaded before the policy came
        self._rng: dict[str, Any] | None = None  # likewise
        self._opponents: dict[str, Any] | None = None  # likewise, their state
        self._networks: dict[int, dict[str, Network]] = {}  # of opponents, by number and policy name

    def describe(self) -> Description:
        """Return what the environment has; the driver opens none."""
        return describe(self.env)

    def take(self, policy: JointPolicy, keeps_ends: bool) -> None:
        """Take the policy that plays from now on.

        Args:
            policy: the worker's own copy, or that of the learners where it runs in their process.
            keeps_ends: see `FollowedEnv.keeps_ends`.
        """
        self._policy = policy
        if self._memories is not None:
            policy.memories = {name: memory.to(self._device) for name, memory in self._memories.items()}
        if policy.opponents is not None and self._opponents is not None:
            policy.opponents.load_state_dict(self._opponents, self._device)

        self._collector = make_collector(followed(self.env, keeps_ends), policy, device=self._device)
        self._batches = BatchCollector(self._collector, self.env, self._cfg.collect, policy.opponents)
        if self._rng is not None:  # last, since building draws too
            set_rng_state(self._rng)

    def collect(self, weights: Weights | None, want_state: bool) -> Message:
        """Collect a batch.

        Args:
            weights: to play with; None: those that the policy has.
            want_state: whether the state behind the batch is returned with it.
        """
        assert self._policy is not None and self._batches is not None, "no policy to play with"
        if weights is not None:
            for name, actor in zip(self._policy.names, self._policy.actors.values()):
                own = dict(weights[name])
                moves = own.pop(MOVES, None)
                actor.load_state_dict(own)
                if moves is not None:  # weights that were saved by an older version do not say
                    assert isinstance(actor, UnityActor)
                    actor.moving_norms = running_norms(actor) if moves else []

        batch = next(self._batches)
        return Message(batch, self.state() if want_state else None)

    def oppose(self, lineup: Lineup) -> None:
        """Let opponents play teams from their next episodes on."""
        assert self._policy is not None, "no policy to play with"
        self._networks |= lineup.networks
        line_up(self._policy, lineup.players[self._number], self._networks, self._device)
        self._networks = {n: network for n, network in self._networks.items() if n in lineup.kept}

    def set_parameter(self, name: str, value: Value) -> None:
        """Set an environment parameter."""
        self.env.set_parameter(name, value)

    def restart(self) -> None:
        """Reset the scene: the next batch begins with new episodes."""
        if self._batches is None:
            self.env.restart()
        else:
            self._batches.restart()

    def state(self) -> dict[str, Any]:
        """Return what resuming needs, with the global generators of random numbers, which it draws from."""
        memories = self._policy.memories if self._policy is not None else self._memories or {}
        opponents = self._policy.opponents if self._policy is not None else None
        return {
            "env": self.env.get_state(),
            "memories": {name: memory.clone() for name, memory in memories.items()},
            "opponents": opponents.state_dict() if opponents is not None else self._opponents,
            "rng": get_rng_state(),
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Go back to a state, before the policy comes.

        Raises:
            ConfigError: it is of another environment.
        """
        # without its environment's state a run begins new episodes, and memories anew with them
        if state["env"] is not None:
            self._memories = dict(state["memories"])
            self.env.set_state(to_arrays(state["env"]))

        opponents = state.get("opponents")
        # of other teams, which a player may show in new episodes, nothing is known
        if opponents is not None and fits_teams(opponents["following"], [self.env]):
            self._opponents = opponents
        self._rng = state.get("rng")

    def close(self) -> None:
        """Close the environment."""
        if self._collector is not None:
            self._collector.shutdown(close_env=False)
            self._collector = None
        if not self.env.is_closed:
            self.env.close()


def worker_config(cfg: Config, number: int, restarts: int = 0) -> Config:
    """Return the options of one of `collect.workers` workers: its share of areas, players and decisions.

    Args:
        cfg: the run's options.
        number: of the worker, from 0.
        restarts: how often it was replaced; each begins with another seed.
    """
    count, env = cfg.collect.workers, cfg.env
    share: dict[str, Any] = {"max_teams": None if env.max_teams is None else -(-env.max_teams // count)}
    if env.backend in (Backend.embedded, Backend.pettingzoo):
        share["num_areas"] = (env.num_areas or count) // count
    elif env.backend in (Backend.player, Backend.registry):
        share["num_players"] = env.num_players // count
        if env.player_logs is not None:
            share["player_logs"] = str(Path(env.player_logs) / worker_folder(number))

    seed = (cfg.seed + WORKER_STRIDE * number + SEED_STRIDE * restarts) % 2**31
    collect = replace(cfg.collect, batch_size=-(-cfg.collect.batch_size // count), workers=0, overlap=False)
    return replace(cfg, env=replace(env, **share), collect=collect, seed=seed)


def worker_folder(number: int) -> str:
    """Return the name of the folder that a worker's players log to."""
    return f"worker-{number}"


def make_unity_env(cfg: Config, players: Path) -> UnityEnv:
    """Open the environment of the options behind the adapter.

    Args:
        cfg: the options.
        players: the folder where players log.
    """
    make_env = (
        make_replay_function(cfg) if cfg.bc.only else make_env_function(cfg.env, players, is_training=True)
    )
    return UnityEnv(
        make_env,
        cfg.seed,
        action_limit=CONTINUOUS_LIMIT,
        max_team_size=cfg.env.max_team_size,
        max_teams=cfg.env.max_teams,
        death_masking=cfg.ppo.death_masking,
    )


def make_worker(cfg: Config, number: int, folder: Path, restarts: int = 0) -> Worker:
    """Open the environment of one of several workers; see `worker_config`."""
    own = worker_config(cfg, number, restarts)
    return Worker(own, make_unity_env(own, folder / PLAYERS / worker_folder(number)), number=number)


def make_collector(env: EnvBase, policy: JointPolicy, rounds: int = 1, device: str = "cpu") -> Collector:
    """Build a collector of endless stretches of so many rounds, on the networks' device."""
    devices = {"policy_device": device, "env_device": "cpu", "storing_device": device}
    return Collector(
        env,
        policy,
        frames_per_batch=rounds,
        total_frames=-1,
        exploration_type=ExplorationType.RANDOM,
        track_traj_ids=False,
        use_buffers=False,  # a batch is a new stack of its rounds,
        return_same_td=device == "cpu",  # so that nothing has to be copied out of it
        trust_policy=True,
        auto_register_policy_transforms=False,
        **({} if device == "cpu" else devices),
    )
