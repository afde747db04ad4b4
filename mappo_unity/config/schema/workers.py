"""What workers have shares of, what they do not go with, and how a preset's give way (`collect.workers`)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Optional

from omegaconf import DictConfig, OmegaConf

from mappo_unity.config.parameters.curriculum import is_curriculum
from mappo_unity.config.schema.collect import in_one_process
from mappo_unity.config.schema.env import Backend, EnvConfig
from mappo_unity.config.schema.self_play import SelfPlayConfig, has_pool


def what_workers_share(env: EnvConfig) -> Optional[tuple[str, Optional[int]]]:
    """Return what each worker has a share of, and how many there are; None: each has a whole environment.

    The number may be None: as many areas as the environment has, which is not known before it is started.
    """
    if env.backend in (Backend.embedded, Backend.pettingzoo):
        return "env.num_areas", env.num_areas
    if env.backend in (Backend.player, Backend.registry):
        return "env.num_players", env.num_players
    if env.backend is Backend.editor:
        return "env.backend", 1
    return None


def what_needs_turns(params: Mapping[str, Any], self_play: SelfPlayConfig) -> Optional[str]:
    """Return what keeps a batch from beginning before the last one is learnt from; None where nothing does.

    Args:
        params: parameters of the environment, as options write them (env.params).
        self_play: its options; without a pool of opponents no side takes turns.
    """
    for name, value in params.items():
        if is_curriculum(value):
            return (
                f"env.params.{name} has lessons, which do not go with collect.overlap=true: "
                "the next batch would begin before its lesson is known"
            )

    if has_pool(self_play) and self_play.team_change is not None:
        return (
            f"self_play.team_change={self_play.team_change} does not go with collect.overlap=true: "
            "the next batch would begin before it is known that the other side learns"
        )
    return None


def let_workers_give_way(tree: DictConfig, given: list[str]) -> None:
    """Let a preset's workers and overlap give way to what was chosen and does not go with them.

    One process cannot collect while it learns, the next lesson or side is known after an update, and clones
    play nothing. Areas, players or the Editor go to as many workers as they can be shared by. Whoever gives
    these options as well is told so by the checks of `Config`.

    Args:
        tree: options that a `Config` is made of, changed in place.
        given: full names of the options that the command line sets.
    """
    collect, env = tree.collect, tree.env
    if not collect.overlap or "collect.overlap" in given:
        return

    params: Any = OmegaConf.to_container(env.params, resolve=False)
    takes_turns = tree.bc.only or what_needs_turns(params, tree.self_play) is not None

    if "collect.workers" not in given:
        _, shared = what_workers_share(env) or ("", collect.workers)
        if takes_turns or shared is None:
            collect.workers = 0
        else:
            collect.workers = math.gcd(collect.workers, shared)

    if takes_turns or in_one_process(collect):
        collect.overlap = False
