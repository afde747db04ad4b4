"""From raw behaviors to what policies see: Stack, CatTensors, Exclude.

In: a `UnityEnv`. Out: a `TransformedEnv` with one entry a policy name, holding ``observation``
(all vector sensors in one) instead of the sensors. Derived from specs alone.
"""

from __future__ import annotations

from torchrl.envs import CatTensors, Compose, ExcludeTransform, Stack, Transform, TransformedEnv

from mappo_unity import keys
from mappo_unity.config import ConfigError
from mappo_unity.unity_env import UnityEnv


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
    """Return the environment that policies see."""
    return TransformedEnv(env, make_transforms(env), cache_specs=True)


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
        CatTensors(in_keys=vectors, out_key=(policy, keys.OBS), dim=-1, sort=False, del_keys=False),
        ExcludeTransform(*vectors),
    ]
