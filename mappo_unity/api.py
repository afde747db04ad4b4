"""What the commands do, as functions for scripts and notebooks; they print nothing by themselves."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError

if TYPE_CHECKING:
    from mappo_unity.policies.policy import Policy
    from mappo_unity.training.outcome import Outcome
    from mappo_unity.training.trainer import AfterIteration


def train(
    *options: str,
    config: str | Path | None = None,
    progress: bool = False,
    after_iteration: AfterIteration | None = None,
) -> Outcome:
    """Train a new run, or resume one, with the options of ``mappo-train``.

        outcome = train("env=3DBall", "seed=1", "max_steps=200000")
        outcome.return_mean, outcome.best_checkpoint

    The run gets a folder as from the command line, below ``outputs/`` where Python runs;
    ``hydra.run.dir=FOLDER`` names another, ``resume=FOLDER`` resumes the one in it.

    Args:
        options: ``name=value``, as on the command line.
        config: a YAML file of options below them.
        progress: show progress and messages on standard output.
        after_iteration: called with the run's state after each iteration; a text that it returns ends the run
            and is its status.

    Returns:
        How the run ended, and where its checkpoints are.

    Raises:
        ConfigError: a mistake in the options, or a resumed run that has nothing left to train.
        EnvironmentFailure: the environment failed for good; what was trained is saved.
    """
    from rich.console import Console

    from mappo_unity.config.renamed import rename_lines
    from mappo_unity.config.text_lines import literal_lines
    from mappo_unity.training.launch import launch

    # as a command line goes: today's names first, then texts as they were typed
    lines = literal_lines(rename_lines(list(options)), Config, False)
    console = Console(quiet=not progress)
    launched = launch(
        lines, None if config is None else Path(config), console.print, console, after_iteration
    )
    if launched.outcome is None:
        raise ConfigError(launched.message)
    return launched.outcome


def load_policy(where: str | Path, deterministic: bool = True, seed: int = 0) -> Policy:
    """Load a trained policy, to act for agents of any `mlagents_envs.base_env.BaseEnv`.

        policy = load_policy("outputs/3DBall/2026-11-20_12-00-00")
        decision, terminal = env.get_steps("3DBall?team=0")
        action = policy.act("3DBall?team=0", decision, env.behavior_specs["3DBall?team=0"])
        env.set_actions("3DBall?team=0", action)

    Before `act` tell it which agents' episodes have ended, with `policy.end(behavior, agent_ids)` and
    `policy.forget(behavior, agent_ids)`: one with a memory would carry it on into the next episode.

    Args:
        where: run folder (its best checkpoint), checkpoint, ONNX file, folder of ONNX files, or "random".
        deterministic: take the most likely action instead of a sampled one.
        seed: of the sampling.

    Raises:
        ConfigError: nothing is there, or nothing that plays.
    """
    # only now: the package can be imported without loading torch
    import torch

    from mappo_unity.policies.evaluate import open_policy

    torch.manual_seed(seed)
    return open_policy(str(where), deterministic, seed)
