"""scripts/make_zoo.py: the options on a policy's card."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf, open_dict

from mappo_unity.config.compose import compose_config

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


def test_what_the_preset_has_as_well_is_no_option_of_a_card(tmp_path):
    own = ["collect.batch_size=2048", "seed=3", "ppo.epochs=7"]
    preset = compose_config(["env=Hallway"]).tree
    same = [f"model.memory={preset.model.memory.name}", f"ppo.gamma={preset.ppo.gamma}"]
    tree = compose_config(["env=Hallway", *own]).tree

    with open_dict(tree):
        tree.pop("hydra")
    OmegaConf.save(tree, tmp_path / "config.yaml")
    assert make_zoo.beyond_preset([own[0], *same, own[2]], tmp_path) == [own[0], own[2]]

    chosen = ["recipe=mlagents", "--config=mine.yaml", "parameters=WallJump_curriculum"]
    assert make_zoo.beyond_preset([*chosen, *same], tmp_path) == chosen
    assert not make_zoo.beyond_preset(["recipe=none", "recipe=null", "parameters=none"], tmp_path)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (
            ["win_rate_vs_random", "0.9", "0.95", ""],
            ["opponent=random"],
        ),  # the last row is after it
        (["entropy", "1.0", "0.9", "0.8"], []),
    ],
)
def test_a_run_that_played_matches_is_measured_by_matches(rows, expected, tmp_path):
    lines = [f"{steps},{cell}" for steps, cell in zip(["agent_steps", 1, 2, 3], rows)]
    (tmp_path / "metrics.csv").write_text("\n".join(lines) + "\n")
    assert make_zoo.opponent(tmp_path) == expected
