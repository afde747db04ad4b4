"""Take the episodes of crashed players out of a batch.

Their decisions become nobody's: they are not learned from and do not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.envs.unity_env import CrashedEpisodes, UnityEnv


def mask_crashed_episodes(
    batch: TensorDictBase, crashes: Sequence[CrashedEpisodes], env: UnityEnv
) -> tuple[int, dict[str, Tensor]]:
    """Set `acting` and `departed` to False in every row of the crashed episodes.

    Args:
        batch: ``[T]``, one entry a policy name, whose last row is the environment's last round.
        crashes: which episodes crashed in rounds of this batch.

    Returns:
        How many rows acted; for each policy name that crashed, bool ``[..., A, 1]``, slots whose crashed
        episode had begun before the batch.
    """
    dropped = 0
    void: dict[str, Tensor] = {}
    for crash in crashes:
        name = keys.policy_name(crash.behavior)
        side = env.sides[name].index(crash.behavior) if len(env.sides[name]) > 1 else None

        done = _of_side(batch.get(("next", name, keys.DONE)), side)
        # Rounds count from where the environment was opened; the newest one is the last row.
        last = batch.shape[0] - env.rounds + crash.round
        rows = episode_rows(done, last, torch.from_numpy(crash.slots).unsqueeze(-1))

        for key in (keys.ACTING, keys.DEPARTED):
            flags = batch.get((name, key)).clone()
            own = _of_side(flags, side)
            dropped += int((own & rows).sum()) if key == keys.ACTING else 0
            own &= ~rows
            batch.set((name, key), flags)

        void.setdefault(name, torch.zeros_like(batch.get((name, keys.ACTING))[0]))
        whose = void[name] if side is None else void[name][side]
        whose |= rows[0]

    return dropped, void


def episode_rows(done_T: Tensor, last: int, slots: Tensor) -> Tensor:
    """Return the rows of the episodes that end in row `last`, bool ``[T, ...]``.

    Args:
        done_T: bool ``[T, ...]``, where episodes ended.
        slots: bool ``[...]``, whose episodes are meant.
    """
    rows = torch.zeros_like(done_T)
    playing = slots.to(done_T.device, copy=True)  # slots come from numpy, the batch may lie on a GPU

    # Backwards from the end, until a row in which the episode before it ended.
    for t in range(last, -1, -1):
        if t < last:
            playing &= ~done_T[t]
        rows[t] = playing

    return rows


def _of_side(values: Tensor, side: int | None) -> Tensor:
    """Return one side's view of an entry; where several share a policy they are stacked, ``[T, S, G, A]``."""
    return values if side is None else values[:, side]
