"""A critic is resumed in the scale in which it learnt, or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from test_train import options

from mappo_unity.config.schema import PPOConfig, ValueNormKind
from mappo_unity.runs import checkpoint
from mappo_unity.training.trainer import train

POPART, RUNNING, NONE = ValueNormKind.popart, ValueNormKind.running, ValueNormKind.none


@pytest.mark.parametrize(
    ("there", "here", "said"),
    [
        (POPART, RUNNING, None),
        (RUNNING, POPART, None),
        (NONE, POPART, None),
        (POPART, NONE, "learnt with ppo.normalize_values=popart or running, and ppo.normalize_values=none "),
        (RUNNING, NONE, "learnt with ppo.normalize_values=popart or running, and ppo.normalize_values=none "),
        (NONE, RUNNING, "learnt with ppo.normalize_values=none, and ppo.normalize_values=running would"),
    ],
)
def test_another_scale_of_values_is_refused(
    tmp_path: Path, there: ValueNormKind, here: ValueNormKind, said: str | None
) -> None:
    cfg = options(1, ppo=PPOConfig(minibatch_size=60, normalize_values=there), export_onnx=False)
    path = train(cfg, tmp_path).last_checkpoint
    assert path is not None

    other = replace(cfg, ppo=PPOConfig(minibatch_size=60, normalize_values=here), max_steps=2 * cfg.max_steps)
    if said is None:
        train(other, tmp_path, path)
        return
    with pytest.raises(checkpoint.CheckpointError, match=said):
        train(other, tmp_path, path)
