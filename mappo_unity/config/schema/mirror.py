"""Options of networks that mirror: `model.mirror.*`."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any

from mappo_unity.errors import ConfigError

WITHOUT_MIRROR = "model.mirror.use=false does without"
"""What to do where networks cannot mirror."""


@dataclass
class MirrorConfig:
    """What an agent senses and does, in a mirror that exchanges left and right; with nothing given: unused.

    Columns are those of the vector observations, all sensors in one, counted from 0. Where a network mirrors,
    it acts in the mirror image of a situation as the mirror image of how it acts in that situation.
    """

    use: bool = True
    """Whether networks mirror, where a mirror image is described; false: presets' descriptions are left
    aside."""
    rays: list[int] = field(default_factory=list)
    """Ray sensors of Unity, four numbers each: first column, rays, numbers of a ray (tags + 2), stacked
    frames; rays to the right and to the left change places."""
    swap: list[int] = field(default_factory=list)
    """Runs of columns that change places, three numbers each: first column of the one, first column of the
    other, length."""
    negate: list[int] = field(default_factory=list)
    """Columns that change their sign; of two that change places, both."""
    flip_images: bool = False
    """Images and grids have a mirror image, too: their columns of pixels or cells in reverse order."""
    swap_actions: list[int] = field(default_factory=list)
    """Continuous actions that change places, two numbers each."""
    negate_actions: list[int] = field(default_factory=list)
    """Continuous actions that change their sign; of two that change places, both."""
    branches: list[int] = field(default_factory=list)
    """Of each discrete action the one that takes its place, branch after branch: [0, 2, 1] for a branch of
    none, left, right; no numbers: all stay."""
    handed: bool = False
    """Networks may prefer a side: where both look alike, they need not go left as often as right."""

    def __post_init__(self) -> None:
        for name, group in (("rays", 4), ("swap", 3), ("swap_actions", 2)):
            numbers = getattr(self, name)
            if len(numbers) % group:
                raise ConfigError(
                    f"model.mirror.{name}={show_numbers(numbers)} holds {len(numbers)} numbers; it takes "
                    f"{group} for each entry"
                )
        for name, numbers in self.lists().items():
            if any(number < 0 for number in numbers):
                raise ConfigError(f"model.mirror.{name}={show_numbers(numbers)} must hold numbers from 0 on")

    def lists(self) -> dict[str, list[int]]:
        """Return the options that are lists of numbers, by their names."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, list)}

    @property
    def is_used(self) -> bool:
        """Whether there is a mirror image."""
        return self.use and (self.flip_images or any(self.lists().values()))

    @property
    def in_effect(self) -> MirrorConfig:
        """What of it matters: itself, or nothing where it is not used."""
        return self if self.is_used else MirrorConfig()


def show_mirror(options: dict[str, Any]) -> str:
    """Return what is given of `MirrorConfig`, which stands there as plain values, in a few words."""
    mirror = asdict(MirrorConfig(**options).in_effect)
    given = {name: value for name, value in mirror.items() if value and name != "use"}
    shown = (f"{name}={'true' if value is True else show_numbers(value)}" for name, value in given.items())
    return f"({' '.join(shown)})" if given else "none"


def show_numbers(numbers: list[int]) -> str:
    """Return numbers as they are given; of many the first ones."""
    shown = ", ".join(map(str, numbers[:8]))
    return f"[{shown}, ...]" if len(numbers) > 8 else f"[{shown}]"
