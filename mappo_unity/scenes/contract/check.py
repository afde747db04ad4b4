"""The checker of the contract of a `BaseEnv`: it plays any environment and sums up what it saw.

A broken rule ends it with a `ContractError` that names the behavior, the agent and what is wrong.

    python -m mappo_unity.scenes.check 3DBall [--steps 500] [--num-areas 4]
    python -m mappo_unity.scenes.check package.module:function [env.params.NAME=VALUE ...]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from mlagents_envs.base_env import BaseEnv

from mappo_unity.config.parameters.values import values_at
from mappo_unity.config.ranges import check_range
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.scenes import make_scene, scene_names
from mappo_unity.scenes.contract.lifecycle import require
from mappo_unity.scenes.contract.play import Report, Trace, play
from mappo_unity.scenes.contract.play import random_actions as random_actions
from mappo_unity.scenes.contract.records import RecordCheck
from mappo_unity.scenes.contract.rules import ContractError, check_plain, check_specs
from mappo_unity.scenes.factory import call_factory, explain_error, load_factory
from mappo_unity.scenes.user_env import GuardedEnv


def check_env(
    env: BaseEnv, steps: int = 300, seed: int = 0, remake: Callable[[], BaseEnv] | None = None
) -> Report:
    """Play `steps` environment steps with random actions and check every record.

    `remake`: makes the same environment with the same seed again; then the same actions must give the
    same records. An environment with `get_state` and `set_state` must repeat itself after `set_state`.
    Leaves the environment open. Raises ContractError, also for what a user's environment raises.
    """
    try:
        return _check_env(_guarded(env), steps, seed, remake)
    except (ConfigError, EnvironmentFailure) as error:
        raise _broken(error) from error


def check_close(env: BaseEnv) -> None:
    """Close an environment; raises ContractError if it cannot be closed."""
    try:
        env.close()
    except Exception as error:
        raise _broken(explain_error(error, f"{type(env).__name__}: its close")) from error


def _check_env(env: Any, steps: int, seed: int, remake: Callable[[], BaseEnv] | None) -> Report:
    rng = np.random.default_rng(seed)
    report = Report()
    env.reset()
    _check_shown(env.behavior_specs)
    _check_errors(env)

    play(env, steps, rng, report)
    require(report.decisions > 0, f"no agent asked for a decision in {steps} steps")

    # A reset in the midst of episodes must leave records that fit, too.
    env.reset()
    play(env, max(1, steps // 10), rng, report)
    report.checks += ["specs", "records", "errors", "reset"]

    snapshots = [hasattr(env, "get_state"), hasattr(env, "set_state")]
    require(
        snapshots[0] == snapshots[1], "of get_state and set_state there is only one: give both, or neither"
    )

    if all(snapshots):
        _check_snapshot(env, max(1, steps // 4), seed)
        report.checks.append("get_state/set_state")

    if remake is not None:
        _check_determinism(remake, max(1, steps // 4), seed)
        report.checks.append("seed")

    return report


def _guarded(env: BaseEnv) -> BaseEnv:
    """Let errors of a user's environment say which method raised them; those of our own are bugs of ours."""
    if type(env).__module__.partition(".")[0] == __name__.partition(".")[0]:
        return env
    return GuardedEnv(env, type(env).__name__, explain_error)


def _broken(error: ConfigError | EnvironmentFailure) -> ContractError:
    broken = ContractError(str(error))
    broken.details = error.details
    return broken


def _check_shown(specs: Any) -> None:
    """Check what behaviors say of themselves, also what no trainer needs."""
    check_specs(specs)
    require(len(specs) > 0, "after reset() there is no behavior: behavior_specs is empty")

    for name, spec in specs.items():
        names = [sensor.name for sensor in spec.observation_specs]
        require(len(set(names)) == len(names), f"{name}: sensor names repeat: {names}")
        for sensor in spec.observation_specs:
            flags, sizes = len(sensor.dimension_property or ()), len(sensor.shape)
            require(
                flags == sizes, f"{name}, sensor {sensor.name}: {flags} dimension properties, not {sizes}"
            )


def _check_errors(env: Any) -> None:
    """Check that wrong names, wrong shapes and agents that requested no decision are refused."""
    name, spec = next(iter(env.behavior_specs.items()))
    decisions, _ = RecordCheck(name, spec)(env.get_steps(name))

    missing = int(max(decisions.agent_id, default=0)) + 10_000
    wrong = spec.action_spec.empty_action(len(decisions) + 1)
    _require_raises(f"set_actions({name!r}) with a row too many", lambda: env.set_actions(name, wrong))

    one = spec.action_spec.empty_action(1)
    _require_raises(
        f"set_action_for_agent({name!r}, {missing}), which did not ask",
        lambda: env.set_action_for_agent(name, missing, one),
    )

    _require_raises("get_steps of an unknown behavior", lambda: env.get_steps("no such behavior"))

    # After all refusals an agent that requested a decision is still served.
    if len(decisions):
        env.set_action_for_agent(name, int(decisions.agent_id[0]), one)


def _check_snapshot(env: Any, steps: int, seed: int) -> None:
    state = env.get_state()
    check_plain(state, "get_state()")

    traces = []
    for _ in range(2):
        env.set_state(state)
        traces.append(play(env, steps, np.random.default_rng(seed), Report()))

    _require_equal(traces[0], traces[1], "after set_state() the same actions give other records")


def _check_determinism(remake: Callable[[], BaseEnv], steps: int, seed: int) -> None:
    traces = []
    for _ in range(2):
        made = remake()
        env = _guarded(made)
        env.reset()
        traces.append(play(env, steps, np.random.default_rng(seed), Report()))
        check_close(made)

    _require_equal(traces[0], traces[1], "the same seed and actions give other records")


def _require_equal(one: Trace, other: Trace, message: str) -> None:
    # Both have the same names in the same order: a step without records adds empty arrays.
    for (where, a), (_, b) in zip(one, other):
        require(a.shape == b.shape and bool((a == b).all()), f"{message} (first {where})")


def _require_raises(what: str, call: Callable[[], Any]) -> None:
    try:
        call()
    except Exception:
        return

    raise ContractError(f"{what} is accepted, but must be refused (UnityActionException or any other error)")


def main(arguments: list[str] | None = None) -> int:
    """Check a scene or a user's environment; return 0 if it keeps the contract, 1 if not, 2 for a mistake."""
    options = _parser().parse_intermixed_args(arguments)

    try:
        make = _maker(options)
        env = make()
        report = check_env(env, options.steps, options.seed, remake=None if options.any_seed else make)
        # Before the close: a closed environment need not show its behaviors.
        lines = _describe(env)
        check_close(env)
    except (ContractError, ConfigError) as error:
        # a factory's own mistakes name it
        name = "" if str(error).startswith(f"{options.scene}: ") else f"{options.scene}: "
        print(f"{name}{error}", *error.details, sep="\n", file=sys.stderr)
        return 1 if isinstance(error, ContractError) else 2
    except KeyboardInterrupt:
        print(f"{options.scene}: interrupted", file=sys.stderr)
        return 130

    print(*lines, _summary(options.scene, report), sep="\n")
    return 0


def _maker(options: argparse.Namespace) -> Callable[[], BaseEnv]:
    """Return what makes the environment that the command line names; raises ConfigError."""
    check_range("--steps", options.steps, 1)
    check_range("--seed", options.seed, 0)
    is_factory = ":" in options.scene
    params = _params(options.params, is_factory)

    if not is_factory:
        return lambda: make_scene(options.scene, seed=options.seed, num_areas=options.num_areas, **params)

    if options.num_areas is not None:
        raise ConfigError("--num-areas is for scenes; give what a factory takes as env.params.NAME=VALUE")

    factory = load_factory(options.scene, options.scene)
    return lambda: call_factory(factory, options.scene, options.seed, params)


def _params(lines: list[str], is_factory: bool) -> dict[str, Any]:
    """Return the parameters of env.params.NAME=VALUE, read as mappo-train reads them; raises ConfigError."""
    from mappo_unity.config.compose import compose_config

    for line in lines:
        if not line.startswith("env.params."):
            raise ConfigError(f"{line} is not of the form env.params.NAME=VALUE")
    if not lines:
        return {}

    # Stand-ins that nobody opens: only the parameters are read. Curricula are at their first lessons.
    taker = ["env=custom", "env.factory=any:one"] if is_factory else ["env=3DBall"]
    params = values_at(compose_config([*taker, *lines]).config.env.parameters, {})

    options = {"seed": "--seed=N"} if is_factory else {"seed": "--seed=N", "num_areas": "--num-areas=N"}
    for name, option in options.items():
        if name in params:
            raise ConfigError(f"env.params.{name} is given by an option of its own: use {option}")
    return params


def _describe(env: BaseEnv) -> list[str]:
    """Return a line about each behavior."""
    lines = []
    for name, spec in env.behavior_specs.items():
        sensors = ", ".join(f"{sensor.name} {tuple(sensor.shape)}" for sensor in spec.observation_specs)
        lines.append(f"behavior {name}: observations {sensors}; actions: {spec.action_spec}")

    return lines


def _summary(scene: str, report: Report) -> str:
    ends = f"{report.terminals:,} episodes ended ({report.interrupted:,} interrupted)"
    return (
        f"{scene} keeps the contract: {report.steps:,} steps, {report.decisions:,} decisions, {ends}, "
        f"{report.terminal_only_steps:,} steps with ends only; checked: {', '.join(report.checks)}, close"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m mappo_unity.scenes.check",
        description="Play an environment with random actions and check what it sends against the rules of "
        "mlagents_envs' BaseEnv.",
    )

    parser.add_argument(
        "scene",
        metavar="ENVIRONMENT",
        help=f"package.module:function, or a scene: {', '.join(scene_names())}",
    )

    parser.add_argument(
        "params",
        nargs="*",
        metavar="env.params.NAME=VALUE",
        help="what it is made with, as mappo-train takes it",
    )

    parser.add_argument("--steps", type=int, default=500, help="environment steps to play; default 500")
    parser.add_argument("--num-areas", type=int, default=None, help="copies of a scene's area")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the environment and the actions; default 0"
    )
    parser.add_argument(
        "--any-seed", action="store_true", help="the same seed need not give the same records"
    )

    return parser


if __name__ == "__main__":
    sys.exit(main())
