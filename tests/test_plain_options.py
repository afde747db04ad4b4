"""What people write who do not know option=value yet."""

from __future__ import annotations

import pytest

from mappo_unity.config.compose import compose_plain
from mappo_unity.config.plain_options import check_form
from mappo_unity.config.schema import EvalConfig, PlayConfig
from mappo_unity.errors import ConfigError


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            "--run=ball",
            "--run is written run=ball: options are written option=value, and the only switches are",
        ),
        ("--run ball", "--run is written run=ball"),
        ("--deterministic", "--deterministic is written deterministic=true"),
        ("deterministic run=ball", "deterministic has no value: it is written deterministic=true"),
        ("--run env=Basic", "--run is written run=VALUE"),
        ("--episods 3", "--episods is not an option (did you mean episodes?)"),
        (
            "-m run=ball",
            "-m is not an option: options are written option=value, and the only switches are --help",
        ),
        ("ball", "'ball' is not of the form option=value (did you mean run=ball?); options: run, episodes"),
        ("episods", "'episods' is not of the form option=value (did you mean episodes?)"),
        ("run ball", "run has no value: it is written run=ball, without spaces"),
        ("run = ball", "run has no value: it is written run=ball, without spaces"),
        ("run =ball", "run has no value: it is written run=ball, without spaces"),
        ("run=ball episodes=3 run=walls", "run is given twice, run=ball and run=walls: give it once"),
        (
            "ppo.lr=3",
            "ppo.lr is an option of mappo-train, not of mappo-eval: a run's own options count; options h",
        ),
        ("env.params.mass=2", "env.params.mass is an option of mappo-train, not of mappo-eval"),
        ("recipe=mlagents", "recipe is an option of mappo-train, not of mappo-eval"),
        ("hydra.run.dir=x", "hydra.run.dir is an option of mappo-train, not of mappo-eval"),
        (
            "video=x.mp4",
            "video is an option of mappo-play and mappo-export, not of mappo-eval; options here: run,",
        ),
        ("run=${env}", "run=${env}: ${...} is for the options of"),
        ("run:ball", "'run:ball' is not of the form option=value: it is written run=ball"),
        ("help", "'help' is not of the form option=value (did you mean --help?)"),
        ("--hlep", "--hlep is not an option (did you mean --help?)"),
        (
            "run=ball seed=1,2",
            "seed=1,2: seed takes one value; a text with a comma stands in quotes inside quotes",
        ),
    ],
)
def test_each_is_told_how_it_is_written(line: str, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        compose_plain(line.split(), EvalConfig)
    assert words in str(error.value) and "mappo-train -m" not in str(error.value)


def test_what_is_written_well_passes() -> None:
    check_form(["run=a b", "run_=1", 'video="x,y.mp4"'], PlayConfig)
    assert compose_plain(["run='a,b'", "episodes=3"], EvalConfig).run == "a,b"
