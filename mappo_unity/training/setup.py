"""What a training run is made of: the environment, the learners and the collector.

What an environment has (sensors, actions, teams) is read from it; what does not fit into memory is refused
before the first step.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch
from mlagents_envs.base_env import BehaviorSpec, ObservationSpec
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ExplorationType

from mappo_unity.config.per_behavior import TRAIN, behavior_config, check_behaviors, is_frozen
from mappo_unity.config.schema import CollectConfig, Config, CriticKind, PPOConfig
from mappo_unity.envs.backends import make_env_function
from mappo_unity.envs.following import followed
from mappo_unity.envs.replay import make_replay_function, read_fitting
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.errors import ConfigError
from mappo_unity.learning.imitation.cloning import Cloning
from mappo_unity.learning.imitation.expert import Expert, make_expert
from mappo_unity.learning.networks.actor_critic import JointPolicy, make_actor, make_critic
from mappo_unity.learning.networks.distributions import CONTINUOUS_LIMIT, ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.networks.images import check_sides
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.learning.rewards.streams import RewardStreams, make_intrinsic
from mappo_unity.runs.folder import PLAYERS
from mappo_unity.runs.logger import check_loggers
from mappo_unity.runs.rng import seed_everything
from mappo_unity.scenes.contract.images import looks_unmarked
from mappo_unity.training.batches import Batch, BatchCollector, count_decisions, count_present
from mappo_unity.training.lessons.curriculum import lessons_of
from mappo_unity.training.memory import check_batch_memory, check_network_memory


class TrainingSetup:
    """The environment, and a learner for every policy name.

    Args:
        cfg: the run's options.
        env: the environment, open.

    Attributes: `learners` by policy name; `policy`, their actors as one; `lessons` of environment parameters;
    `notes`, lines for the user; `frozen`, the policy names that only play; `guesses_channels`, whether
    `guess_channels` built the networks.

    Raises:
        ConfigError: options do not fit the environment, or what they ask for does not fit into memory.
    """

    def __init__(self, cfg: Config, env: UnityEnv) -> None:
        self.cfg, self.env = cfg, env
        self.notes = [f"note: {cfg.env.note}"] if cfg.env.note is not None else []
        self.lessons = lessons_of(cfg.env, env)
        self.notes += self.lessons.notes

        self.guesses_channels = False
        self._make_learners(self.notes.append)
        if len(self.frozen) == len(self.learners):
            raise ConfigError(
                f"behaviors.{next(iter(self.frozen))}.{TRAIN}=false: nothing is learnt, since every behavior "
                "of the environment is frozen; mappo-eval plays without learning"
            )

    def guess_channels(self) -> None:
        """Build the networks again as older versions did: an image's smaller dimension holds its channels."""
        self.guesses_channels = True
        self._make_learners(lambda note: None)

    def _make_learners(self, note: Callable[[str], None]) -> None:
        rounds = batch_rounds(self.cfg.collect, self.env)
        self.learners = make_learners(self.cfg, self.env, rounds, note, self.guesses_channels)
        self.policy = JointPolicy({name: learner.actor for name, learner in self.learners.items()})

        self.frozen = {name for name in self.learners if is_frozen(self.cfg, name)}
        for name in self.frozen:
            self.learners[name].actor.moving_norms = []

    @contextmanager
    def collecting(self) -> Iterator[BatchCollector]:
        """Yield endless batches, collected from where the environment stands."""
        keeps_ends = any(learner.rewards.intrinsic for learner in self.learners.values())
        env = followed(self.env, keeps_ends)
        collector = make_collector(env, self.policy, device=self.cfg.device)
        try:
            yield BatchCollector(collector, self.env, self.cfg.collect)
        finally:
            # `set_up` opened the environment, and closes it
            collector.shutdown(close_env=False)

    def learn(self, batch: Batch, progress: float) -> dict[str, dict[str, float]]:
        """Improve every policy by a batch; return the metrics of each.

        Args:
            batch: as collected.
            progress: share of the run that was over when the batch began, 0 to 1, for the schedules.
        """
        share = count_decisions(batch.rounds, self.learners) / self.cfg.max_steps
        # Large minibatches gain from threads; small networks, while collecting, do not.
        torch.set_num_threads(min(self.cfg.update_threads, os.cpu_count() or 1))
        metrics: dict[str, dict[str, float]] = {}
        for name, learner in self.learners.items():
            if name in batch.void:
                learner.carried.void(batch.void[name])
            if name not in self.frozen:
                ahead = share if learner.cfg.schedules_count_batch else 0.0
                metrics[name] = learner.learn(*batch.of(name), progress + ahead)
            if self.frozen:
                metrics.setdefault(name, {})["frozen"] = float(name in self.frozen)
        torch.set_num_threads(self.cfg.num_threads)
        return metrics

    def forget_pending(self) -> None:
        """Drop the decisions whose outcome has not arrived: the environment was reset."""
        for learner in self.learners.values():
            learner.carried.rounds = None


@contextmanager
def set_up(cfg: Config, folder: Path) -> Iterator[TrainingSetup]:
    """Open the environment and build what learns; close the environment at the end of the block.

    Args:
        cfg: the run's options.
        folder: the run's folder; players log below it.

    Raises:
        ConfigError: see `TrainingSetup`; the device or a logger is not there.
    """
    prepare_torch(cfg)
    check_loggers(cfg.log)
    env = make_unity_env(cfg, folder)
    try:
        yield TrainingSetup(cfg, env)
    finally:
        if not env.is_closed:
            env.close()


def prepare_torch(cfg: Config) -> None:
    """Set threads and seeds; check the device."""
    torch.set_num_threads(cfg.num_threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces every storage
    check_device(cfg.device)
    seed_everything(cfg.seed)


def check_device(device: str) -> None:
    """Raise ConfigError if torch does not find the device of the networks."""
    if device == "cpu":
        return
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if not count:
        raise ConfigError(f"device={device}: this torch finds no CUDA device; use device=cpu")
    if int(device.partition(":")[2] or 0) >= count:
        raise ConfigError(f"device={device}: the last CUDA device that torch finds is cuda:{count - 1}")


def make_unity_env(cfg: Config, folder: Path) -> UnityEnv:
    """Open the environment of the options behind the adapter; players log below the run's folder."""
    make_env = make_replay_function(cfg) if cfg.bc.only else make_env_function(cfg.env, folder / PLAYERS)
    return UnityEnv(
        make_env,
        cfg.seed,
        action_limit=CONTINUOUS_LIMIT,
        max_team_size=cfg.env.max_team_size,
        max_teams=cfg.env.max_teams,
        death_masking=cfg.ppo.death_masking,
    )


def batch_rounds(cfg: CollectConfig, env: UnityEnv) -> int:
    """Return the rounds of a batch in which all agents act that the environment began with."""
    if cfg.rounds is not None:
        return cfg.rounds
    # agents that are there, not slots: some of these may stay empty
    return -(-cfg.batch_size // max(1, count_present(env)))


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


def make_learners(
    cfg: Config,
    env: UnityEnv,
    rounds: int,
    note: Callable[[str], None],
    guess_channels: bool = False,
) -> dict[str, PolicyLearner]:
    """Build networks and learner of every policy name.

    Args:
        cfg: the run's options.
        env: what is played.
        rounds: of a batch.
        note: takes a line for the user about an option that does not fit and follows another, or about an
            image that says nothing of its channels.
        guess_channels: see `ObsLayout.from_shapes`.

    Raises:
        ConfigError: options do not fit the environment, or what they ask for does not fit into memory.
    """
    check_behaviors(cfg, env.sides)
    check_batch_memory(cfg, env, rounds)

    learners = {}
    for name, sides in env.sides.items():
        model, ppo, rewards, _ = behavior_config(cfg, name)
        behavior = env.behaviors[sides[0]]
        # sides that share a policy are stacked: all their teams are rows of its batch
        teams, team_size = behavior.slots.num_teams * len(sides), behavior.slots.team_size
        check_minibatches(name, ppo, rounds, teams, team_size, note)

        sensors = behavior.spec.observation_specs
        obs = ObsLayout.from_specs(sensors)
        if guess_channels:
            obs = ObsLayout.from_shapes([sensor.shape for sensor in sensors])
        note_unmarked(name, sensors, note)
        check_sides(name, sensors, model.image_encoder)
        layout = ActionLayout.from_spec(behavior.spec.action_spec, model.flatten_branches)
        check_network_memory(name, obs, layout, team_size, model, rewards)

        # Built after the check, so that what does not fit is refused by a line of ours.
        learners[name] = _make_learner(cfg, name, obs, layout, team_size, behavior.spec)

    return learners


def _make_learner(
    cfg: Config, name: str, obs: ObsLayout, layout: ActionLayout, team_size: int, spec: BehaviorSpec
) -> PolicyLearner:
    model, ppo, rewards, bc = behavior_config(cfg, name)
    actor = make_actor(obs, layout, team_size, model).to(cfg.device)

    def expert(demos: list[str]) -> Expert:
        return make_expert(read_fitting(demos, spec, name), obs.keys, cfg.device)

    # a value for each stream of rewards
    judged = expert(rewards.gail.demos) if rewards.gail.strength else None
    intrinsic = make_intrinsic(obs, layout, rewards, cfg.device, judged)
    critic = make_critic(obs, team_size, model, layout, 1 + len(intrinsic)).to(cfg.device)
    shares = model.critic is CriticKind.poca and team_size > 1
    streams = RewardStreams(ppo, rewards, intrinsic, obs.keys, shares)

    share = bc.steps / cfg.max_steps if bc.steps else None
    cloning = Cloning(actor, expert(bc.demos), bc, ppo, share) if bc.demos else None
    return PolicyLearner(actor, critic, ppo, streams, cloning)


def note_unmarked(name: str, sensors: Sequence[ObservationSpec], note: Callable[[str], None]) -> None:
    """Note images that mark no dimension, are taken for ``C, H, W``, and look like ``H, W, C``."""
    for sensor in filter(looks_unmarked, sensors):
        channels, height, width = sensor.shape
        note(
            f"note: sensor {sensor.name!r} of {name} has shape {tuple(sensor.shape)} and marks no "
            f"dimensions: it is taken for {channels} channels of {height} x {width}; mark height and width "
            "with dimension_property where that is not so"
        )


def check_minibatches(
    name: str, ppo: PPOConfig, rounds: int, teams: int, team_size: int, note: Callable[[str], None]
) -> None:
    """Note a minibatch larger than the batch; raise ConfigError for more minibatches than team rows."""
    rows, agents = rounds * teams, teams * team_size
    if (ppo.num_minibatches or 0) > rows:
        raise ConfigError(
            f"ppo.num_minibatches={ppo.num_minibatches} is larger than the batch of {name!r}: {rounds} "
            f"rounds x {teams} teams = {rows} team rows; lower ppo.num_minibatches, or raise "
            "collect.batch_size (or collect.rounds, where it is given)"
        )

    if ppo.num_minibatches is None and ppo.minibatch_size > rows * team_size:
        note(
            f"note: ppo.minibatch_size={ppo.minibatch_size} is larger than the batch of {name}: {rounds} "
            f"rounds x {agents} agents = {rows * team_size} decisions, learnt as one minibatch"
        )
