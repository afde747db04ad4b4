"""The transforms between a `UnityEnv` and its policies: sides are stacked, vector sensors joined.

They give one entry a policy name, which holds ``observation`` (all vector sensors in one) instead of those
sensors, and are derived from specs alone.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.envs import CatTensors, Compose, ExcludeTransform, Stack, Transform, TransformedEnv

from mappo_unity import keys
from mappo_unity.envs.tensordicts import unchecked
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.errors import ConfigError


def make_transforms(env: UnityEnv) -> Compose:
    """Return the transforms of an environment.

    Raises:
        ConfigError: two sides of one name differ in sensors or actions.
    """
    transforms: list[Transform] = []
    for policy, sides in env.sides.items():
        transforms += _stack_sides(env, policy, sides) if len(sides) > 1 else []
        transforms += _concatenate(env, policy, sides[0])
    return Compose(*transforms)


def transformed(env: UnityEnv) -> TransformedEnv:
    """Return the environment that policies see, its ``next`` entries whole."""
    return TransformedUnityEnv(env, make_transforms(env), cache_specs=True)


class TransformedUnityEnv(TransformedEnv):
    """A `TransformedEnv` whose rounds cost a fraction of TorchRL's own and hold the same entries.

    TorchRL completes ends that are missing, looks for ends and resets what ended. A `UnityEnv` has
    written every end and already stands in the next episodes, so a step and a look at its root do.
    Transforms beyond those of `make_transforms`, and entries that neither they nor a policy of ours
    write (a recurrent one's state), are left to TorchRL.
    """

    _own_keys: dict[str, set[str]] | None = None  # of every policy name; empty: leave all to TorchRL

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Play a round; return it with its ``next`` entry, and the root of the round after it."""
        if not self._holds_own_keys(tensordict):
            return super().step_and_maybe_reset(tensordict)

        if tensordict.device != self.device:
            tensordict = tensordict.to(self.device)

        env, transform, shape = self.base_env, self.transform, self.batch_size
        actions = {n: unchecked({keys.ACTION: e.get(keys.ACTION)}, e.shape) for n, e in tensordict.items()}

        following = transform._call(env._step(transform._inv_call(unchecked(actions, shape))))

        # only where an episode ended does the next row begin with another observation than this one ends with
        asked = transform._call(env.root()) if env.round_ended else following
        root = {name: _without_rewards(entries, self.device) for name, entries in asked.items()}

        tensordict.set("next", following)
        return tensordict, unchecked(root, shape, self.device)

    def empty_cache(self) -> None:
        """Forget what was derived from the specs and transforms, which have changed."""
        self._own_keys = None
        super().empty_cache()

    def _holds_own_keys(self, tensordict: TensorDictBase) -> bool:
        if self._own_keys is None:
            self._own_keys = self._find_own_keys()

        own = self._own_keys
        if set(tensordict.keys()) != own.keys():
            return False
        return all(own[name].issuperset(entries.keys()) for name, entries in tensordict.items())

    def _find_own_keys(self) -> dict[str, set[str]]:
        transforms = self.transform.transforms if isinstance(self.transform, Compose) else [self.transform]
        # exact types: a subclass may do more
        if not all(type(transform) in (Stack, CatTensors, ExcludeTransform) for transform in transforms):
            return {}

        written = {keys.ACTION, keys.LOG_PROB, keys.LOG_PROBS, keys.MEMORY, keys.PLAYER}
        beside = written | {keys.DONE, keys.TERMINATED, keys.TRUNCATED}
        return {name: beside.union(spec.keys()) for name, spec in self.observation_spec.items()}


def _without_rewards(entries: TensorDictBase, device: torch.device | None) -> TensorDictBase:
    kept = {k: v for k, v in entries.items() if k != keys.REWARD and k != keys.GROUP_REWARD}
    return unchecked(kept, entries.shape, device)


def _stack_sides(env: UnityEnv, policy: str, sides: list[str]) -> list[Transform]:
    first = env.behaviors[sides[0]].spec

    for side in sides[1:]:
        spec = env.behaviors[side].spec
        shapes = [o.shape for o in spec.observation_specs]
        expected = [o.shape for o in first.observation_specs]
        if shapes != expected or not spec.action_spec == first.action_spec:
            raise ConfigError(
                f"behaviors {sides[0]!r} and {side!r} share the policy {policy!r} but differ: sensors "
                f"{expected} and {shapes}, actions {first.action_spec} and {spec.action_spec}; give them "
                "different behavior names in Unity"
            )

    # S becomes the first dimension of the entry: [S, G, A, ...]
    return [Stack(in_keys=list(sides), out_key=policy, in_key_inv=policy, out_keys_inv=list(sides), dim=-3)]


def _concatenate(env: UnityEnv, policy: str, behavior: str) -> list[Transform]:
    specs = env.behaviors[behavior].spec.observation_specs
    vectors = [(policy, keys.SENSOR.format(i)) for i, spec in enumerate(specs) if len(spec.shape) == 1]
    if not vectors:
        return []
    return [
        # not sorted: by name obs_10 would come before obs_2
        CatTensors(in_keys=vectors, out_key=(policy, keys.OBS), dim=-1, sort=False, del_keys=False),
        ExcludeTransform(*vectors),
    ]
