"""Environment parameters of a scene: their values in force, drawn anew with each reading where samplers are.

As in Unity (EnvironmentParameters.GetWithDefault) whoever reads a parameter gets a new draw, so every area
that begins an episode has a number of its own. Each sampler has its own generator.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mappo_unity.config.parameters.samplers import Sampler, Value
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.core.specs import Parameter, checked_parameter, known_parameter


class Parameters(Mapping[str, float]):
    """Parameters by name: ``parameters["mass"]`` is one number, `draw` one for each of several areas.

    Args:
        scene: name, for messages.
        known: what the scene reads.
        seed: the scene's; samplers without a seed draw from it.
    """

    def __init__(self, scene: str, known: Mapping[str, Parameter], seed: int) -> None:
        self._scene, self._known, self._seed = scene, known, seed
        self._values: dict[str, Value] = {name: parameter.default for name, parameter in known.items()}
        self._rngs: dict[str, np.random.Generator] = {}

    def set(self, name: str, value: Any) -> None:
        """Set a parameter to a number or a `Sampler`, which draws from its seed on.

        Raises:
            ConfigError: see `check`.
        """
        self._values[name] = self.check(name, value)
        if isinstance(value, Sampler):
            # a stream of its own: the scene draws from the seed's, and one begins with the seed itself
            seed = np.random.SeedSequence(value.seed_within(self._seed), spawn_key=(1,))
            self._rngs[name] = np.random.default_rng(seed)

    def check(self, name: str, value: Any) -> Value:
        """Return the value as it is set; raise ConfigError for an unknown name and a value out of range."""
        if not isinstance(value, Sampler):
            return checked_parameter(self._scene, self._known, name, value)

        parameter = known_parameter(self._scene, self._known, name)
        if parameter.at_once:
            raise ConfigError(
                f"parameter {name} of scene {self._scene} acts at once and not at a reset, so it takes no "
                f"sampler ({value}): give a number, or lessons with numbers"
            )
        if value.lowest <= parameter.above:
            raise ConfigError(
                f"parameter {name} of scene {self._scene} is out of range: what {value} draws must be > "
                f"{parameter.above:g}"
            )
        return value

    def draw(self, name: str, count: int) -> np.ndarray:
        """Return the number of each of `count` readers, float64 [count]."""
        value = self._values[name]
        if not isinstance(value, Sampler):
            return np.full(count, value)

        numbers = draw(value, self._rngs[name], count)
        # a Gaussian reaches below any bound; more than half of its draws are above, as `check` saw to
        while (low := numbers <= self._known[name].above).any():
            numbers[low] = draw(value, self._rngs[name], int(low.sum()))
        return numbers

    def __getitem__(self, name: str) -> float:
        value = self._values[name]
        return float(self.draw(name, 1)[0]) if isinstance(value, Sampler) else value

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def get_state(self) -> dict[str, Any]:
        """Return what a snapshot needs: numbers, and of samplers all that `set_state` makes them from."""
        return {name: self._saved(name, value) for name, value in self._values.items()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore what `get_state` returned."""
        for name, saved in state.items():
            if not isinstance(saved, Mapping):
                self._values[name] = saved
                continue
            numbers = tuple(float(number) for number in saved["numbers"])
            self._values[name] = Sampler(saved["kind"], numbers, saved["seed"], saved["order"])
            self._rngs[name] = np.random.default_rng()
            self._rngs[name].bit_generator.state = saved["rng"]

    def _saved(self, name: str, value: Value) -> Any:
        if not isinstance(value, Sampler):
            return value
        rng = self._rngs[name].bit_generator.state
        numbers = list(value.numbers)
        return {"kind": value.kind, "numbers": numbers, "seed": value.seed, "order": value.order, "rng": rng}


def draw(sampler: Sampler, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return numbers from a distribution, float64 [count]."""
    first, second = sampler.numbers[:2]
    if sampler.kind == "uniform":
        return rng.uniform(first, second, count)
    if sampler.kind == "gaussian":
        return rng.normal(first, second, count)

    # one uniform number along the intervals laid end to end: the wider one is, the likelier
    lows, highs = np.array(sampler.numbers[::2]), np.array(sampler.numbers[1::2])
    ends = np.cumsum(highs - lows)
    along = rng.uniform(0, ends[-1], count)
    which = np.minimum(np.searchsorted(ends, along, side="right"), len(ends) - 1)
    return np.maximum(highs[which] - (ends[which] - along), lows[which])
