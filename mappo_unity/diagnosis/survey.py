"""What a run's batches held: observations, masks, rewards, ends; counted while it trains, kept as JSON.

Rewards and ends are counted in every batch. Observations and masks are looked at in the first batch and then
ever more rarely (the 2nd, 4th, 8th ...), in at most `ROWS` of its decisions: that costs nothing that a run
would feel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mlagents_envs.base_env import BehaviorSpec
from tensordict import TensorDictBase

from mappo_unity import keys
from mappo_unity.diagnosis.survey_file import write_survey
from mappo_unity.envs.rounds import Episode

ROWS = 4096
"""Decisions of a batch in which observations are looked at."""
RETURNS = 1024
"""Episodes of which the returns are kept: every one, every second one, every fourth one ..."""
_SHARE_AT_END = 0.1  # of an element's values that are its least, or its greatest, before it may be clipped
_DISTINCT = 16  # values between both ends: with fewer it is a category, not a measure that was clipped


class PolicySurvey:
    """What the batches of one policy name held.

    Args:
        spec: of its behaviors, which are alike.

    Attributes: `facts`, everything by name, as `Survey.as_dict` returns it.
    """

    def __init__(self, spec: BehaviorSpec) -> None:
        # plain numbers, as JSON knows them: a spec of one's own may hold NumPy's
        self._branches = [int(size) for size in spec.action_spec.discrete_branches]
        self._acted: np.ndarray | None = None  # rounds in which each slot's agent asked, and was there
        self._there: np.ndarray | None = None
        self._looks = 0
        self._every = 1  # episode of which the return is kept

        vectors = [(s.name, int(s.shape[0])) for s in spec.observation_specs if len(s.shape) == 1]
        self.facts: dict[str, Any] = {
            "branches": self._branches,
            "continuous": int(spec.action_spec.continuous_size),
            "vectors": vectors,
            "decisions": 0,
            "rewards": {"count": 0, "nonzero": 0, "at_ends": 0, "least": 0.0, "greatest": 0.0},
            "episodes": {"count": 0, "of_one_decision": 0, "least": None, "greatest": None},
            "returns": [],
            "slots": {"all": 0, "idle": 0},
            "opposed": False,  # whether an opponent has ever played its agents
            "elements": None,
            "images": {},
            "sets": {},
            "same_for_all": None,
            "one_action": None,
            "never_allowed": None,
        }

    # --- in every batch

    def count(self, rounds: TensorDictBase, following: TensorDictBase) -> None:
        """Count decisions, rewards and agents of a batch ``[T, ..., A]``."""
        acting = rounds.get(keys.ACTING).flatten(1).cpu().numpy()
        present = rounds.get(keys.PRESENT).flatten(1).cpu().numpy()
        self.facts["decisions"] += int(acting.sum())

        # an opponent's agents are asked, too, but ACTING says nothing of them
        played = rounds.get(keys.PLAYER, None)
        ours = present if played is None else present & (played.flatten(1).cpu().numpy() == keys.LEARNER)
        self.facts["opposed"] |= bool(np.count_nonzero(present) > np.count_nonzero(ours))

        # slots may become more while a run goes on
        if self._acted is None or len(self._acted) != acting.shape[1]:
            self._acted = np.zeros(acting.shape[1], int)
            self._there = np.zeros(acting.shape[1], int)
        self._acted += acting.sum(0)
        self._there += ours.sum(0)
        often_there = self._there >= 500
        idle = often_there & (self._acted * 500 <= self._there)
        self.facts["slots"] = {"all": int(often_there.sum()), "idle": int(idle.sum())}

        reward = (following.get(keys.REWARD) + following.get(keys.GROUP_REWARD)).flatten(1).cpu().numpy()
        done = following.get(keys.DONE).flatten(1).cpu().numpy()
        seen = self.facts["rewards"]
        seen["count"] += int(present.sum())
        seen["nonzero"] += int(np.count_nonzero(reward))
        seen["at_ends"] += int(np.count_nonzero(reward[done]))
        seen["least"] = min(seen["least"], float(reward.min()))
        seen["greatest"] = max(seen["greatest"], float(reward.max()))

    def count_episodes(self, episodes: Sequence[Episode]) -> None:
        """Count finished episodes; those without a decision say nothing."""
        seen = self.facts["episodes"]
        for episode in episodes:
            if not episode.length:
                continue
            value = episode.individual_return + episode.group_return
            seen["count"] += 1
            seen["of_one_decision"] += episode.length == 1
            seen["least"] = value if seen["least"] is None else min(seen["least"], value)
            seen["greatest"] = value if seen["greatest"] is None else max(seen["greatest"], value)
            self._keep(value, seen["count"])

    def _keep(self, value: float, count: int) -> None:
        """Keep some of the returns, evenly over the run."""
        kept = self.facts["returns"]
        if count % self._every == 0:
            kept.append(float(f"{value:.6g}"))
        if len(kept) > RETURNS:
            kept[:] = kept[1::2]
            self._every *= 2

    # --- in some

    def look(self, rounds: TensorDictBase) -> None:
        """Look at observations and masks of a batch ``[T, ..., A]``."""
        asked = rounds.get(keys.ACTING).squeeze(-1)
        places = asked.reshape(-1).nonzero().squeeze(-1)
        if not len(places):
            return
        places = places[:: -(-len(places) // ROWS)]
        self._looks += 1

        def rows(key: str) -> torch.Tensor:
            entry = rounds.get(key)
            return entry.reshape(-1, *entry.shape[asked.dim() :])[places].cpu()

        names = set(rounds.keys())
        others = sorted(n for n in names if n.startswith(keys.SENSOR.format("")))  # images and sets
        if keys.OBS in names:
            self._look_at_elements(rows(keys.OBS).float().numpy())
            if not others:  # an agent's own camera tells it where it is, though its vectors do not
                self._compare_agents(rounds.get(keys.OBS), asked)
        for name in others:
            values = rows(name)
            self._look_at_range("sets" if values.dim() == 3 else "images", name, values)
        if keys.MASK in names:
            self._look_at_masks(rows(keys.MASK).numpy())

    def _look_at_elements(self, values: np.ndarray) -> None:
        least, greatest = values.min(0), values.max(0)
        at_least, at_greatest = (values == least).mean(0), (values == greatest).mean(0)
        clipped = (np.minimum(at_least, at_greatest) >= _SHARE_AT_END) & (least < greatest)
        for element in clipped.nonzero()[0]:
            clipped[element] = len(np.unique(values[:, element])) >= _DISTINCT + 2

        seen = self.facts["elements"]
        if seen is not None and len(seen["least"]) == len(least):
            least = np.minimum(least, seen["least"])
            greatest = np.maximum(greatest, seen["greatest"])
        self.facts["elements"] = {
            "least": least.tolist(),
            "greatest": greatest.tolist(),
            "clipped": clipped.nonzero()[0].tolist(),
            "clipped_share": float((at_least + at_greatest)[clipped].mean()) if clipped.any() else 0.0,
        }

    def _compare_agents(self, observation: torch.Tensor, asked: torch.Tensor) -> None:
        """Note whether all agents see the same in every round, though it changes from round to round."""
        whole = asked.flatten(1).all(1).nonzero().squeeze(-1)
        if len(whole) < 2 or asked[0].numel() < 2:
            return
        rounds = observation[whole[:: -(-len(whole) // 64)]].flatten(1, observation.dim() - 2)
        is_alike = bool((rounds == rounds[:, :1]).all()) and bool((rounds != rounds[:1]).any())
        self.facts["same_for_all"] = is_alike and self.facts["same_for_all"] is not False

    def _look_at_range(self, kind: str, name: str, values: torch.Tensor) -> None:
        seen = self.facts[kind].get(name)
        least, greatest = float(values.min()), float(values.max())
        if seen is not None:
            least, greatest = min(least, seen["least"]), max(greatest, seen["greatest"])
        self.facts[kind][name] = {"least": least, "greatest": greatest}

    def _look_at_masks(self, allowed: np.ndarray) -> None:
        starts = np.cumsum([0, *self._branches[:-1]])
        one = (np.add.reduceat(allowed.astype(int), starts, axis=1) == 1).all(1).mean()
        never = set((~allowed.any(0)).nonzero()[0].tolist())

        before = self.facts["never_allowed"]
        self.facts["never_allowed"] = sorted(never if before is None else never & set(before))
        share = self.facts["one_action"] or 0.0
        self.facts["one_action"] = share + (float(one) - share) / self._looks


class Survey:
    """What a run's batches held, policy by policy.

    Args:
        specs: of each behavior.
        sides: behaviors of each policy name, which are alike.
    """

    def __init__(self, specs: Mapping[str, BehaviorSpec], sides: Mapping[str, Sequence[str]]) -> None:
        self._policies = {name: PolicySurvey(specs[behaviors[0]]) for name, behaviors in sides.items()}
        self._sides = sides
        self._batches = 0

    def add(self, rounds: TensorDictBase, episodes: Mapping[str, Sequence[Episode]]) -> bool:
        """Take a batch ``[T]`` in, as learners get it; return whether it was looked at closely."""
        self._batches += 1
        is_closer = self._batches.bit_count() == 1

        for name, policy in self._policies.items():
            policy.count(rounds.get(name), rounds.get(("next", name)))
            for side in self._sides[name]:
                policy.count_episodes(episodes.get(side, ()))
            if is_closer:
                policy.look(rounds.get(name))
        return is_closer

    def as_dict(self) -> dict[str, Any]:
        """Return what was seen, by policy name, as JSON knows it."""
        return {name: policy.facts for name, policy in self._policies.items()}

    def write(self, folder: Path) -> None:
        """Write survey.json into a run folder, in one piece."""
        write_survey(folder, self.as_dict())
