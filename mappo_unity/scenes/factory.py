"""Environments of a user's own: from the name package.module:function to a BaseEnv.

What the user's code raises becomes one line, with the user's frames of the traceback. There is one rule for
where modules are found: Python's path, and the working directory.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from traceback import TracebackException
from typing import Any

from mlagents_envs.base_env import BaseEnv

from mappo_unity.config.option_table import did_you_mean, with_article
from mappo_unity.config.schema import EnvConfig
from mappo_unity.config.user_modules import add_working_directory
from mappo_unity.errors import ConfigError, EnvironmentFailure

OUR_FRAMES = (
    "<frozen importlib",
    str(Path(inspect.getfile(importlib)).parent),
    str(Path(__file__).parents[1]),
)
"""Beginnings of file names in a traceback that say nothing about a user's code."""


def call_factory(factory: Callable[..., Any], name: str, seed: int, params: Mapping[str, Any]) -> BaseEnv:
    """Return a user's environment.

    Raises:
        ConfigError: the factory does not take the parameters, raised something (its `details` are the user's
            frames of the traceback), or returned no BaseEnv. ConfigError and EnvironmentFailure of its own
            pass.
    """
    # First, so that a TypeError from within the factory is not taken for a wrong parameter.
    check_call(factory, name, params)

    with explained(name):
        env = factory(seed=seed, **params)

    if not isinstance(env, BaseEnv):
        raise ConfigError(
            f"{name} returned {with_article(type(env).__name__)}; it must return a "
            "mlagents_envs.base_env.BaseEnv"
        )

    return env


def check_call(
    factory: Callable[..., Any], name: str, params: Mapping[str, Any], has_seed: bool = True
) -> None:
    """Raise ConfigError if a factory does not take these parameters, and a seed, as its signature says."""
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):
        return  # a builtin without one

    try:
        signature.bind(**({"seed": 0} if has_seed else {}), **params)
    except TypeError as error:
        names = ", ".join(params)
        given = f"seed and {names or 'nothing else'}" if has_seed else names or "nothing"
        raise ConfigError(
            f"{name} cannot be called with {given}: {error}; it is "
            f"{getattr(factory, '__name__', 'function')}{signature}"
        ) from error


def load_factory(path: str, name: str) -> Callable[..., Any]:
    """Return the function that package.module:function names; raises ConfigError, which calls it `name`."""
    module_name, _, function_name = path.partition(":")
    add_working_directory()

    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # the user's module raises what it likes
        raise explain_error(error, f"{name}: the module {module_name} cannot be imported: it") from error

    function = getattr(module, function_name, None)
    if callable(function):
        return function
    if function is not None:
        kind = with_article(type(function).__name__)
        raise ConfigError(f"{name}: {function_name} is {kind}, but must be a function that returns a BaseEnv")

    # What the module imported may be meant, but is not worth a list.
    public = {n: value for n, value in vars(module).items() if callable(value) and not n.startswith("_")}
    names = sorted(n for n, value in public.items() if getattr(value, "__module__", None) == module_name)
    more = ", ..." if len(names) > 20 else ""

    raise ConfigError(
        f"{name}: {module_name} has no function {function_name!r}{did_you_mean(function_name, public)}; "
        f"it has {', '.join(names[:20]) or 'none'}{more}"
    )


def check_factory(cfg: EnvConfig) -> None:
    """Raise ConfigError if env.factory is given and cannot be imported, or is no function."""
    if cfg.factory is not None:
        load_factory(cfg.factory, f"env.factory={cfg.factory}")


@contextmanager
def explained(who: str) -> Iterator[None]:
    """Let a user's code run: what it raises becomes a ConfigError (see `explain_error`).

    A ConfigError and an EnvironmentFailure of its own pass.
    """
    try:
        yield
    except (ConfigError, EnvironmentFailure):
        raise
    except (Exception, SystemExit) as error:
        raise explain_error(error, who) from error


def explain_error(error: BaseException, who: str) -> ConfigError:
    """Return the mistake "`who` raised ..." with the traceback of the user's code, without our frames."""
    text = str(error).strip()
    mistake = ConfigError(
        f"{who} raised {type(error).__name__}" + (f": {' '.join(text.split())}" if text else "")
    )

    # Errors that this one came from show only the user's frames, too.
    report = TracebackException.from_exception(error)
    part: TracebackException | None = report
    while part is not None:
        part.stack[:] = [frame for frame in part.stack if not frame.filename.startswith(OUR_FRAMES)]
        part = part.__cause__ or part.__context__

    mistake.details = tuple("".join(report.format()).splitlines())
    return mistake
