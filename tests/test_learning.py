"""Learning to a good score with the shipped presets. Slow: minutes, not seconds."""

from pathlib import Path

import pytest

from mappo_unity.config.compose import compose_config
from mappo_unity.policies.evaluate import evaluate
from mappo_unity.runs.folder import write_record
from mappo_unity.training.trainer import train


@pytest.mark.slow
def test_3dball_is_solved_with_its_preset_and_the_checkpoint_plays_as_well(tmp_path: Path) -> None:
    lines = ["env=3DBall", "log.loggers=[]", "log.progress=false"]
    cfg = compose_config(lines).config
    write_record(tmp_path, cfg, lines)
    outcome = train(cfg, tmp_path)
    assert outcome.return_mean >= 99.0
    figures = evaluate(tmp_path, episodes=50, deterministic=True)
    assert figures["mean_return"] >= 99.0
    assert figures["interrupted"] > 0.95
