"""ONNX files as policies: our own exports and those of ML-Agents (model formats 2 and 3).

Format 3 has an input for each sensor (``obs_i``) and gives branch indices; format 2 has all vectors
in one (``vector_observation``) and gives log-probabilities, from which branches are drawn here.
Recurrent files get each agent's memory back until its episode ends.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mlagents_envs.base_env import ActionTuple, BehaviorSpec, DecisionSteps

from mappo_unity import keys
from mappo_unity.config.packages import import_package
from mappo_unity.errors import ConfigError
from mappo_unity.policies.policy_files import SUFFIX
from mappo_unity.scenes.contract.images import LAST, channel_dim


class OnnxPolicy:
    """Play an ONNX file.

    Args:
        path: the file.
        deterministic: take the most likely action instead of a sampled one.
        seed: of what is drawn, inside the graph too.

    Raises:
        ConfigError: the file cannot be read, is no ML-Agents model, or has no deterministic outputs.
        ExportError: the package onnxruntime is missing.
    """

    def __init__(self, path: Path, deterministic: bool, seed: int = 0) -> None:
        if not path.is_file():
            raise ConfigError(f"the ONNX file {path} does not exist")

        self.path, self.deterministic = path, deterministic
        self.session = open_session(path.read_bytes(), str(path), seed)
        self.metadata: dict[str, str] = self.session.get_modelmeta().custom_metadata_map
        steps = self.metadata.get("agent_steps", "")
        self.agent_steps = int(steps) if steps.isdigit() else None

        self.inputs = {i.name: list(i.shape) for i in self.session.get_inputs()}
        self.outputs = {o.name: list(o.shape) for o in self.session.get_outputs()}

        self.rng = np.random.default_rng(seed)
        self._memory: dict[tuple[str, int], np.ndarray] = {}
        self._fits: set[str] = set()
        self._check_outputs()

    def act(self, behavior: str, steps: DecisionSteps, spec: BehaviorSpec) -> ActionTuple:
        """Return an action for every row of ``steps``."""
        self.check(behavior, spec)
        branches = spec.action_spec.discrete_branches
        feed = self._feed(behavior, steps, spec)
        try:
            outputs = self.session.run(list(self.outputs), feed)
        except Exception as error:  # onnxruntime raises many kinds, without a common base
            what = f"the ONNX file {self.path} cannot play {len(steps)} agents of {behavior!r} at once"
            raise ConfigError(f"{what}: {str(error).strip().splitlines()[0][:300]}") from error
        out = dict(zip(self.outputs, outputs))
        if "recurrent_out" in out:
            memory = out["recurrent_out"].reshape(len(steps), -1)
            self._memory.update({(behavior, a): m for a, m in zip(steps.agent_id.tolist(), memory)})

        action = ActionTuple()
        if spec.action_spec.continuous_size:
            action.add_continuous(out[self._output("continuous_actions")].astype(np.float32))

        if branches:
            # Format 2 gives log-probabilities, format 3 indices: the type tells them apart.
            chosen = out[self._output("discrete_actions")]
            chosen = self._draw(chosen, branches) if np.issubdtype(chosen.dtype, np.floating) else chosen
            action.add_discrete(chosen.astype(np.int32))

        return action

    def forget(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Drop the memory of agents that begin an episode."""
        for agent in agent_ids:
            self._memory.pop((behavior, int(agent)), None)

    def end(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Do nothing: what was remembered is dropped when an agent begins again."""

    def check(self, behavior: str, spec: BehaviorSpec) -> None:
        """Raise ConfigError if this file cannot play that behavior."""
        # Called with every step: what fitted once is not compared again.
        if behavior in self._fits:
            return
        name = self.metadata.get("behavior_name")
        if name not in (None, keys.policy_name(behavior)):
            raise ConfigError(
                f"the ONNX file {self.path} plays {name!r}, but the environment has {behavior!r}; "
                "a folder with a file for each behavior plays several"
            )

        wanted, given = self._wanted_sizes(), self._given_sizes(spec)
        if wanted != given:
            raise ConfigError(
                f"the ONNX file {self.path} cannot play {behavior!r}: it takes and gives "
                f"{_show(wanted)}, but the environment has {_show(given)}"
            )

        self._fits.add(behavior)

    def _check_outputs(self) -> None:
        actions = [n for n in ("continuous_actions", "discrete_actions") if n in self.outputs]
        if not actions or not any(n.startswith(("obs_", "vector_obs", "visual_obs")) for n in self.inputs):
            raise ConfigError(
                f"the ONNX file {self.path} is no ML-Agents model of format 2 or 3: its inputs are "
                f"{list(self.inputs)}, its outputs {list(self.outputs)}"
            )

        for name in actions:
            if self.deterministic and self._output(name) == name and not self._gives_log_probs(name):
                raise ConfigError(
                    f"the ONNX file {self.path} has no output deterministic_{name}: "
                    "only deterministic=false can play it"
                )

    def _output(self, name: str) -> str:
        twin = f"deterministic_{name}"
        return twin if self.deterministic and twin in self.outputs else name

    def _gives_log_probs(self, name: str) -> bool:
        kinds = {o.name: o.type for o in self.session.get_outputs()}
        return name == "discrete_actions" and kinds[name] == "tensor(float)"

    def _wanted_sizes(self) -> dict[str, list[int]]:
        sizes = {name: shape[1:] for name, shape in self.inputs.items() if name != "recurrent_in"}
        if "continuous_actions" in self.outputs:
            sizes["continuous_actions"] = self.outputs["continuous_actions"][1:]
        if "discrete_actions" in self.outputs:
            sizes["discrete_actions"] = self.outputs["discrete_actions"][1:]
        return sizes

    def _given_sizes(self, spec: BehaviorSpec) -> dict[str, list[int]]:
        """What the file would have to take and give for that behavior."""
        sensors = [list(o.shape) for o in spec.observation_specs]
        if any(name.startswith("obs_") for name in self.inputs):
            sizes = {f"obs_{i}": shape for i, shape in enumerate(sensors)}
        else:
            vectors = [s[0] for s in sensors if len(s) == 1]
            sizes = {"vector_observation": [sum(vectors)]} if vectors else {}
            images = [s for s in sensors if len(s) == 3]
            sizes |= {f"visual_observation_{i}": shape for i, shape in enumerate(images)}

        # Files take images channels last or first; what theirs are, their inputs tell.
        for name, shape in sizes.items():
            if self.inputs.get(name, [])[1:] == _channels_first(shape):
                sizes[name] = _channels_first(shape)

        continuous, branches = spec.action_spec.continuous_size, spec.action_spec.discrete_branches
        if continuous:
            sizes["continuous_actions"] = [continuous]
        if branches:
            # Format 2 gives a log-probability for every choice, format 3 the choice of each branch.
            log_probs = "discrete_actions" in self.outputs and self._gives_log_probs("discrete_actions")
            sizes["action_masks"] = [sum(branches)]
            sizes["discrete_actions"] = [sum(branches) if log_probs else len(branches)]

        return sizes

    def _feed(self, behavior: str, steps: DecisionSteps, spec: BehaviorSpec) -> dict[str, np.ndarray]:
        vectors = [o for o in steps.obs if o.ndim == 2]
        images = [i for i, o in enumerate(steps.obs) if o.ndim == 4]
        last = [channel_dim(sensor) == LAST for sensor in spec.observation_specs]

        feed = {}
        for name, shape in self.inputs.items():
            index = int(name.rpartition("_")[2]) if name.startswith(("obs_", "visual_")) else 0
            if name.startswith("obs_"):
                feed[name] = fit_image(steps.obs[index], shape, last[index])
            elif name == "vector_observation":
                feed[name] = np.concatenate(vectors, axis=1)
            elif name.startswith("visual_"):
                feed[name] = fit_image(steps.obs[images[index]], shape, last[images[index]])
            elif name == "action_masks":
                feed[name] = _allowed(steps, spec.action_spec.discrete_branches)
            else:  # recurrent_in, the only one left after `check`
                zeros = np.zeros(shape[-1], np.float32)
                rows = [self._memory.get((behavior, agent), zeros) for agent in steps.agent_id.tolist()]
                feed[name] = np.stack(rows).reshape(len(steps), 1, -1)

        return {name: np.ascontiguousarray(values, np.float32) for name, values in feed.items()}

    def _draw(self, log_probs: np.ndarray, branches: Sequence[int]) -> np.ndarray:
        """Branches ``[n, K]`` from the log-probabilities ``[n, sum of branches]`` of format 2."""
        parts = np.split(log_probs, np.cumsum(branches)[:-1], axis=1)
        # The largest sum of log-probability and Gumbel noise is a draw from the probabilities.
        noise = [0.0 if self.deterministic else self.rng.gumbel(size=part.shape) for part in parts]
        return np.stack([(part + extra).argmax(1) for part, extra in zip(parts, noise)], axis=1)


class OnnxFolder:
    """Play each behavior with the file of its name in a folder (``SmallWallJump.onnx`` ...).

    Args:
        path: the folder.
        deterministic: take the most likely action instead of a sampled one.
        seed: of what is drawn.
    """

    agent_steps = None

    def __init__(self, path: Path, deterministic: bool, seed: int = 0) -> None:
        self.path, self.deterministic, self.seed = path, deterministic, seed
        self._policies: dict[str, OnnxPolicy] = {}

    def act(self, behavior: str, steps: DecisionSteps, spec: BehaviorSpec) -> ActionTuple:
        """Return an action for every row of ``steps``."""
        return self._policy(behavior).act(behavior, steps, spec)

    def check(self, behavior: str, spec: BehaviorSpec) -> None:
        """Raise ConfigError if there is no file for that behavior, or one that cannot play it."""
        self._policy(behavior).check(behavior, spec)

    def forget(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Drop the memory of agents that begin an episode."""
        self._policy(behavior).forget(behavior, agent_ids)

    def end(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Do nothing: see `OnnxPolicy.end`."""

    def _policy(self, behavior: str) -> OnnxPolicy:
        name = keys.policy_name(behavior)
        if name not in self._policies:
            path = file_in(self.path, name)
            if not path.is_file():
                files = sorted(p.name for p in self.path.glob(f"*{SUFFIX}"))
                raise ConfigError(f"{behavior!r} needs a file {path}; there are {', '.join(files) or 'none'}")
            self._policies[name] = OnnxPolicy(path, self.deterministic, self.seed)
        return self._policies[name]


def file_in(folder: Path, policy: str) -> Path:
    """Return the file of a policy in a folder: under its own name, as ML-Agents writes it, or `file_name`."""
    own = folder / f"{policy}{SUFFIX}"
    return own if own.is_file() else folder / file_name(policy)


def file_name(policy: str) -> str:
    """Return the name of a policy's file: its own, with ``_`` for what a file name may not hold."""
    return keys.file_stem(policy) + SUFFIX


def open_session(data: bytes, name: str, seed: int = 0) -> Any:
    """Open a model in onnxruntime, on one thread.

    Args:
        name: what errors call it.
        seed: of the graph's random numbers.

    Raises:
        ExportError: the package onnxruntime is missing.
        ConfigError: it is no model that onnxruntime can run.
    """
    runtime = import_package("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # files of ML-Agents bring warnings about declared shapes
    # Before the session is made: its random operators take their seeds from it.
    runtime.set_seed(seed)

    try:
        return runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises many kinds, without a common base
        reason = str(error).strip().splitlines()[0][:300]
        raise ConfigError(f"{name} is no ONNX model that onnxruntime can run: {reason}") from error


def fit_image(values: np.ndarray, shape: Sequence[Any], channels_last: bool) -> np.ndarray:
    """Turn images ``[n, H, W, C]`` into ``[n, C, H, W]`` where the model's input has that shape.

    `channels_last`: what the sensor says, for images whose shape is the same both ways.
    """
    size = list(values.shape[1:])
    fits = len(size) == 3 and list(shape[1:]) == _channels_first(size)
    if fits and (channels_last or size != list(shape[1:])):
        return values.transpose(0, 3, 1, 2)
    return values


def _channels_first(shape: Sequence[int]) -> list[int]:
    return [shape[2], shape[0], shape[1]] if len(shape) == 3 else list(shape)


def _allowed(steps: DecisionSteps, branches: Sequence[int]) -> np.ndarray:
    if steps.action_mask is None:
        return np.ones((len(steps), sum(branches)), np.float32)
    return 1.0 - np.concatenate([np.asarray(m) for m in steps.action_mask], axis=1).astype(np.float32)


def _show(sizes: dict[str, list[int]]) -> str:
    return ", ".join(f"{name} {list(size)}" for name, size in sizes.items())
