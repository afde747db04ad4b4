"""What a card says of an exported policy, gathered: from its checkpoint, its run's record, and by playing."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mappo_unity import keys
from mappo_unity.config.compose import load_config
from mappo_unity.config.schema import Backend, Config, PlayConfig
from mappo_unity.envs.backends import make_env_function
from mappo_unity.envs.opening import first_results
from mappo_unity.errors import ConfigError
from mappo_unity.policies.evaluate import evaluate
from mappo_unity.policies.first_checks import behaviors_seen
from mappo_unity.policies.layouts import sides_of
from mappo_unity.policies.onnx_policy import OnnxPolicy
from mappo_unity.policies.policy_files import RANDOM
from mappo_unity.runs import checkpoint as checkpoints
from mappo_unity.runs.folder import CONFIG, VERSIONS, find_run
from mappo_unity.runs.json_record import read_json
from mappo_unity.runs.metrics_csv import STEP, read_metrics
from mappo_unity.runs.options import config_to_play
from mappo_unity.scenes import scene_names
from mappo_unity.scenes.contract.rules import MAX_SILENT_STEPS
from mappo_unity.sharing.card import Earned, Facts, LastWindow, Training, Won
from mappo_unity.sharing.train_line import train_line
from mappo_unity.viewing.play import play

_VERSIONS = ("mappo-unity", "python", "torch", "torchrl", "mlagents-envs", "mujoco")
FILM_S, FILM_SIZE = 8.0, (480, 272)


@dataclass(frozen=True)
class Trained:
    """A checkpoint, and the run that it lies in, if it lies in one."""

    path: Path
    state: dict[str, Any]
    run: Path | None

    @classmethod
    def read(cls, path: Path) -> Trained:
        """Read a checkpoint. Raises CheckpointError."""
        run = None
        with suppress(ConfigError):
            run = find_run(path, "run")
        return cls(path, checkpoints.load(path), run)

    @property
    def env(self) -> str | None:
        """The preset to play it in; None: that of its run."""
        return self.state["env_name"] if self.run is None else None


def gather(
    trained: Trained, files: Mapping[str, Path], episodes: int | None, film: Path | None
) -> list[Facts]:
    """Return the facts of each policy of a checkpoint; plays for the score and the film.

    Args:
        files: the ONNX file of each policy.
        episodes: to play for the score, with two sides matches against random; None: the run's own figures.
        film: the video to link, which is there already.
    """
    config = load_config(trained.run / CONFIG) if trained.run is not None else None
    specs = _specs(trained, episodes)
    scores = _measured(trained, episodes, specs) if episodes else {}

    facts = []
    for name, layout in trained.state["layout"].items():
        branches, sensors = layout["branches"], layout["sensors"]

        facts.append(
            Facts(
                policy=name,
                file=files[name].name,
                env=trained.state["env_name"],
                agent_steps=trained.state["agent_steps"],
                sensors=list(zip(_sensor_names(specs, name, len(sensors)), sensors)),
                continuous=layout["continuous"],
                discrete=f"branches of {', '.join(map(str, branches))}" if branches else "",
                team_size=layout["team_size"],
                training=_training(trained, config),
                score=scores.get(name) or _last_window(trained, name),
                film=film.name if film is not None else None,
                is_scene=trained.state["env_name"] in scene_names(),
            )
        )
    return facts


def make_film(trained: Trained, path: Path) -> None:
    """Film a checkpoint in its embedded scene. Raises ConfigError."""
    width, height = FILM_SIZE
    run = str(trained.path)
    play(PlayConfig(run=run, env=trained.env, video=str(path), seconds=FILM_S, width=width, height=height))


def facts_of_file(path: Path) -> Facts:
    """Return what an ONNX file says of itself, where no card lies beside it. Raises ConfigError."""
    policy = OnnxPolicy(path, deterministic=False)
    sensors = [(name, shape[1:]) for name, shape in policy.inputs.items() if "obs" in name]
    env = policy.metadata.get("env_name", "")
    count = policy.outputs["discrete_actions"][-1] if "discrete_actions" in policy.outputs else 0
    choices = policy.inputs.get("action_masks", [0])[-1]
    return Facts(
        policy=policy.metadata.get("behavior_name", path.stem),
        file=path.name,
        env=env,
        agent_steps=policy.agent_steps,
        is_scene=not env or env in scene_names(),
        sensors=sensors,
        continuous=policy.outputs.get("continuous_actions", [0])[-1],
        discrete=f"{choices} choices in {count} branch{'es' * (count > 1)}" if count else "",
    )


def _specs(trained: Trained, episodes: int | None) -> Mapping[str, Any]:
    """Return the specs of an environment's behaviors; of one that has to be started only to play in it."""
    try:
        env = config_to_play(trained.path, trained.env).env
    except ConfigError:  # a preset or a factory of somebody else's: only the card knows less
        if episodes:
            raise
        return {}

    if env.backend is Backend.embedded or not episodes:
        return behaviors_seen(env)
    base_env = make_env_function(env)(0)
    try:
        base_env.reset()
        return {name: first.spec for name, first in first_results(base_env, MAX_SILENT_STEPS).items()}
    finally:
        base_env.close()


def _sensor_names(specs: Mapping[str, Any], policy: str, count: int) -> list[str]:
    """Return the names of a policy's sensors; numbers where its environment was not opened."""
    for behavior, spec in specs.items():
        if keys.policy_name(behavior) == policy:
            return [sensor.name for sensor in spec.observation_specs]
    return [f"obs_{i}" for i in range(count)]


def _measured(trained: Trained, episodes: int, behaviors: Iterable[str]) -> dict[str, Earned | Won]:
    """Play for the score of each policy, with sampled actions as Unity's agents do."""
    names = list(behaviors)
    if len(sides_of(names)) == 2:
        result = evaluate(trained.path, episodes, opponent=RANDOM, env=trained.env)
        won = Won(
            share=result["won_of_decided"],
            low=result["won_of_decided_low95"],
            high=result["won_of_decided_high95"],
            **{name: result[name] for name in ("wins", "draws", "losses")},
            together=len(trained.state["layout"]) > 1,
        )
        return {keys.policy_name(name): won for name in names}

    result = evaluate(trained.path, episodes, env=trained.env)
    by_name = result.get("behaviors") or {names[0]: result}
    return {
        keys.policy_name(name): Earned(row["mean_return"], row["stderr"], row["episodes"])
        for name, row in by_name.items()
    }


def _last_window(trained: Trained, policy: str) -> LastWindow | None:
    """Return what the run's metrics say up to the checkpoint, None where they are gone."""
    if trained.run is None:
        return None
    try:
        rows = read_metrics(trained.run / "metrics.csv")
    except (OSError, ValueError):
        return None

    rows = [row for row in rows if row[STEP] <= trained.state["agent_steps"]]
    # Of several behaviors each has a column: "Goalie?team=1/return_mean".
    columns = rows[-1] if rows else {}
    own = [name for name in columns if name.endswith("/return_mean") and _policy(name) == policy]
    mean = _last(rows, *own, "return_mean")
    if mean is None:
        return None

    series = next((row for row in reversed(rows) if "draw_rate_vs_random" in row), None)
    if series is None:
        return LastWindow(mean)
    return LastWindow(mean, series.get("win_rate_vs_random", math.nan), series["draw_rate_vs_random"])


def _policy(column: str) -> str:
    return keys.policy_name(column.rpartition("/")[0])


def _last(rows: Sequence[Mapping[str, float]], *names: str) -> float | None:
    """Return the last number of the first of some columns that has one."""
    for name in names:
        found = [row[name] for row in rows if not math.isnan(row.get(name, math.nan))]
        if found:
            return found[-1]
    return None


def _training(trained: Trained, config: Config | None) -> Training | None:
    if trained.run is None or config is None:
        return None

    versions = read_json(trained.run / VERSIONS)
    return Training(
        command=train_line(config),
        seed=config.seed,
        backend=config.env.backend.value,
        areas=config.env.num_areas,
        wall_s=trained.state.get("wall_s"),
        versions={name: str(versions[name]) for name in _VERSIONS if versions.get(name)},
    )
