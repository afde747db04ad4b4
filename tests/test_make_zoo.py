"""scripts/make_zoo.py: the options on a policy's card."""

from __future__ import annotations

import sys
from pathlib import Path

import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import make_zoo


def test_an_option_that_was_given_again_stands_once(tmp_path):
    begun = ["env=Walker", "seed=0", "max_steps=12_000_000", "ppo.gamma=0.99", "hydra.run.dir=runs/walk"]
    resumed = ["resume=runs/walk", "max_steps=15_000_000", "ppo.entropy_coef_final=-0.01"]
    entries = [{"date": "-", "overrides": lines} for lines in (begun, resumed)]
    (tmp_path / "overrides.yaml").write_text(yaml.safe_dump(entries))
    assert make_zoo.given(tmp_path) == [
        "max_steps=15_000_000",
        "ppo.gamma=0.99",
        "ppo.entropy_coef_final=-0.01",
    ]
