"""The learners of all policy names, built for an environment: networks, reward streams, demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from mlagents_envs.base_env import BehaviorSpec, ObservationSpec

from mappo_unity.config.per_behavior import behavior_config, check_behaviors
from mappo_unity.config.schema import Config, CriticKind, ModelConfig, PPOConfig
from mappo_unity.envs.replay import read_fitting
from mappo_unity.errors import ConfigError
from mappo_unity.learning.imitation.cloning import Cloning
from mappo_unity.learning.imitation.expert import Expert, make_expert
from mappo_unity.learning.networks.actor_critic import make_actor, make_critic, with_traces
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.networks.images import check_sides
from mappo_unity.learning.networks.mirror import make_mirror
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.learning.rewards.streams import RewardStreams, make_intrinsic
from mappo_unity.learning.torch_settings import check_compiles
from mappo_unity.scenes.contract.images import looks_unmarked
from mappo_unity.training.collection.description import Played, describe
from mappo_unity.training.memory import check_batch_memory, check_network_memory


def make_learners(
    cfg: Config,
    env: Played,
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
        check_columns(name, obs, layout, model)
        check_network_memory(name, obs, layout, team_size, model, rewards)

        # Built after the check, so that what does not fit is refused by a line of ours.
        learners[name] = _make_learner(cfg, name, obs, layout, team_size, behavior.spec)

    return learners


def _make_learner(
    cfg: Config, name: str, obs: ObsLayout, layout: ActionLayout, team_size: int, spec: BehaviorSpec
) -> PolicyLearner:
    model, ppo, rewards, bc = behavior_config(cfg, name)
    actor = make_actor(obs, layout, team_size, model).to(cfg.device)
    if ppo.compile:
        check_compiles(name, actor, cfg.device)

    def expert(demos: list[str]) -> Expert:
        return make_expert(read_fitting(demos, spec, name), obs.keys, cfg.device)

    # a value for each stream of rewards
    judged = expert(rewards.gail.demos) if rewards.gail.strength else None
    intrinsic = make_intrinsic(obs, layout, rewards, cfg, judged, model.image_encoder)
    critic = make_critic(obs, team_size, model, layout, 1 + len(intrinsic)).to(cfg.device)
    shares = model.critic is CriticKind.poca and team_size > 1
    streams = RewardStreams(ppo, rewards, intrinsic, obs.keys, shares)

    cloning = Cloning(actor, expert(bc.demos), bc, ppo, cfg.max_steps) if bc.demos else None
    return PolicyLearner(actor, critic, ppo, streams, cloning)


def check_learners(cfg: Config, env: Played, learners: Mapping[str, PolicyLearner]) -> None:
    """Raise ConfigError where several learners cannot share the teams of the policies that learn."""
    if cfg.learners == 1:
        return

    description = describe(env)
    for name, learner in learners.items():
        learner.check_joins(cfg.learners)
        teams = description.teams(name)
        if cfg.learners > teams:
            raise ConfigError(
                f"learners={cfg.learners} is more than the teams of {name!r}, of which each learner gets "
                f"some: there are {teams}; lower learners, or raise env.num_areas"
            )


def check_columns(name: str, obs: ObsLayout, layout: ActionLayout, model: ModelConfig) -> None:
    """Raise ConfigError, naming the policy, where `model.mirror` or traces do not fit it."""
    try:
        for traces in (model.traces_of_actor(obs.vector), model.traces_of_critic(obs.vector)):
            make_mirror(model.mirror, with_traces(obs, *traces), layout)
    except ConfigError as error:
        raise ConfigError(f"{error} ({name})") from error


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
