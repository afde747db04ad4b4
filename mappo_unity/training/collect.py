"""The collector: policies and an environment in, batches ``[T, ...]`` out.

In: a `TransformedEnv`, the joint policy, `CollectConfig`. Out: a TorchRL `Collector`.
"""

from __future__ import annotations

from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ExplorationType

from mappo_unity.config.schema import CollectConfig
from mappo_unity.learning.actor_critic import JointPolicy


def num_rounds(cfg: CollectConfig, agents: int) -> int:
    """Return the rounds of a batch for an environment in which so many agents act."""
    return -(-cfg.batch_size // max(1, agents)) if cfg.rounds is None else cfg.rounds


def make_collector(env: EnvBase, policy: JointPolicy, rounds: int, device: str = "cpu") -> Collector:
    """Build a collector of endless batches of so many rounds, on the networks' device."""
    devices = (
        {} if device == "cpu" else {"policy_device": device, "env_device": "cpu", "storing_device": device}
    )
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
        **devices,
    )
