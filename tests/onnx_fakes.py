"""Actors and observations for the tests of ONNX files, and another client's reading of such files."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from mappo_unity.config.schema import ModelConfig
from mappo_unity.learning.networks.actor_critic import make_actor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout, RunningNorm
from mappo_unity.policies.onnx_graph import build_model


def make(sensors, continuous=0, branches=(), joint=False, team_size=1, head_scale=200, goals=None, **model):
    """Return an actor whose outputs differ from row to row, its normaliser moved."""
    torch.manual_seed(0)
    layout = ActionLayout(continuous, tuple(branches), joint)
    cfg = ModelConfig(**{"hidden": [32, 32], "init_log_std": -0.5} | model)
    actor = make_actor(ObsLayout.from_shapes(sensors, goals=goals), layout, team_size, cfg)
    net = getattr(actor[0].module, "actor", actor[0].module)  # of one that has traces: the networks
    with torch.no_grad():
        if team_size == 1:
            net.net[-1].weight.mul_(head_scale)
            net.net[-1].bias.normal_()
            if cfg.normalize_obs and any(len(s) == 1 for s in sensors):
                norm = next(m for m in net.encoder.modules() if isinstance(m, RunningNorm))
                norm.update(torch.randn(500, sum(s[0] for s in sensors if len(s) == 1)) * 3 + 1)
    return actor


def inputs(sensors, branches=(), rows=40):
    """Return random inputs of an actor; every branch keeps an allowed action."""
    torch.manual_seed(1)
    sample = {f"obs_{i}": torch.rand(rows, *s) for i, s in enumerate(sensors) if len(s) != 1}
    for i, shape in enumerate(sensors):
        if len(shape) == 2:
            # from none to all of the entities are there
            sample[f"obs_{i}"][torch.rand(rows, shape[0]) < torch.rand(rows, 1) * 2 - 0.5] = 0.0
    vectors = sum(s[0] for s in sensors if len(s) == 1)
    if vectors:
        sample["observation"] = torch.randn(rows, vectors) * 3 + 1
    if branches:
        masks = [torch.rand(rows, size) < 0.6 for size in branches]
        for mask in masks:
            mask[torch.arange(rows), torch.randint(mask.shape[1], (rows,))] = True
        sample["action_mask"] = torch.cat(masks, -1)
    return sample


def data_of(actor, sensors, name="Fake", **metadata):
    return build_model(actor[0].module, sensors, name, metadata).SerializeToString()


def run_policy(shared: Path) -> ModuleType:
    """Return the script run_policy.py, which knows Unity's contract and nothing of ours."""
    spec = importlib.util.spec_from_file_location("run_policy", shared / "oracle" / "run_policy.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def official_policy(shared, path, deterministic):
    """Return run_policy.py's reading of a file."""
    return run_policy(shared).OfficialPolicy(str(path), np.random.default_rng(0), deterministic)
