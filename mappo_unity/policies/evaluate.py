"""What mappo-eval does: play a policy in its environment, alone or against an opponent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mappo_unity.config.parameters.samplers import Sampler
from mappo_unity.config.schema import EnvConfig
from mappo_unity.envs.backends import make_env_function
from mappo_unity.policies.episodes import play, summarize
from mappo_unity.policies.matches import Score, play_matches
from mappo_unity.policies.onnx_policy import OnnxFolder, OnnxPolicy
from mappo_unity.policies.policy import CheckpointPolicy, Policy, RandomPolicy
from mappo_unity.policies.policy_files import Kind, at_its_lessons, choose_checkpoint, locate
from mappo_unity.runs.options import config_to_play


def evaluate(
    run: Path | str,
    episodes: int,
    deterministic: bool = False,
    seed: int = 0,
    opponent: str | None = None,
    env: str | None = None,
    params: Sequence[str] = (),
) -> dict[str, Any]:
    """Play a run's policy in its own environment, or in another.

    Args:
        run: run folder (its best checkpoint plays, else its newest), checkpoint, ONNX file, zoo or ./zoo.
        episodes: agent episodes of every behavior; with an opponent, matches.
        opponent: "random", or another run, checkpoint or ONNX file, for environments with two sides.
        env: preset of the environment; None = that of the run.
        params: lines such as env.params.mass=2; what they leave out has the values of the run, a curriculum
            those of the lesson that the checkpoint had reached.

    Returns:
        Figures for the table and the JSON line of mappo-eval.

    Raises:
        ConfigError: no checkpoint, or one that does not fit the environment.
    """
    torch.set_num_threads(1)
    torch.manual_seed(seed)

    policy = open_policy(str(run), deterministic, seed)
    options = at_its_lessons(config_to_play(Path(run), env, params).env, str(run))
    make_env = make_env_function(options)

    # which of a run's checkpoints it is; anything else as it was given
    played = policy.path if isinstance(policy, CheckpointPolicy) else run
    head: dict[str, Any] = {"policy": str(played), "deterministic": deterministic, "seed": seed}
    head |= _more_head(policy, options)
    if opponent is not None:
        other = open_policy(opponent, deterministic, opponent_seed(seed), "opponent")
        scores = play_matches(make_env, policy, other, episodes, seed)
        return head | {"opponent": opponent} | match_figures(scores)

    base_env = make_env(seed)
    try:
        finished = play(base_env, policy, episodes)
    finally:
        base_env.close()

    # The figures of a single behavior stand at the top, those of several below their names.
    behaviors = {name: summarize(rows) for name, rows in finished.items()}
    return head | (next(iter(behaviors.values())) if len(behaviors) == 1 else {"behaviors": behaviors})


def opponent_seed(seed: int) -> int:
    """Return the opponent's seed: with ours it would draw the numbers that ours draws, and play alike."""
    return int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]) % 2**31


def _more_head(policy: Policy, env: EnvConfig) -> dict[str, Any]:
    """Return what a policy says of its training, and the environment parameters in force."""
    head: dict[str, Any] = {}
    if isinstance(policy, (CheckpointPolicy, OnnxPolicy, OnnxFolder)):
        head["agent_steps"] = policy.agent_steps
    if env.params:
        values = env.parameters.items()
        head["env.params"] = {n: str(value) if isinstance(value, Sampler) else value for n, value in values}
    return head


def match_figures(scores: dict[str, Score]) -> dict[str, Any]:
    """Return the figures of matches, over both sides and as each."""
    total = Score()
    for score in scores.values():
        total += score
    return total.figures() | {"as": {side: score.figures() for side, score in scores.items()}}


def open_policy(where: str, deterministic: bool, seed: int, option: str = "run") -> Policy:
    """Return "random", or the policy of a run folder, checkpoint, ONNX file or folder of ONNX files.

    Raises:
        ConfigError: nothing is there (named by ``option``), or nothing that plays.
    """
    source = locate(where, option)
    if source.kind is Kind.random:
        return RandomPolicy(seed)
    if source.kind is Kind.onnx:
        return OnnxPolicy(source.path, deterministic, seed)
    if source.kind is Kind.onnx_folder:
        return OnnxFolder(source.path, deterministic, seed)
    return CheckpointPolicy(choose_checkpoint(source.path, option), deterministic)
