"""Completion: bash itself, given the script, is asked what it would offer."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

from mappo_unity.cli import completion, train_main
from mappo_unity.config.option_table import option_table
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError

needs_bash = pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")


def offers(line: str, breaks: str = " =") -> list[str]:
    """Return what bash puts in place of the line's last word, with the given word breaks."""
    code = f"""{completion.completion_script("bash")}
COMP_WORDBREAKS='{breaks}' COMP_LINE='{line}' COMP_POINT={len(line)}
_mappo_complete {line.split()[0]}
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


@needs_bash
def test_bash_offers_presets_values_and_names() -> None:
    assert offers("mappo-train env=W") == ["Walker", "WallJump"]
    assert offers("mappo-train env=W", breaks=" ") == ["env=Walker", "env=WallJump"]
    assert offers("mappo-train seed=1 recipe=m") == ["mappo_paper", "mlagents"]
    assert offers("mappo-train model.memory=") == ["none", "lstm", "gru", "traces"]
    assert offers("mappo-train env.no_graphics=t") == ["true"]
    assert offers("mappo-train hydra/la") == ["hydra/launcher="]
    assert offers("mappo-train ppo.lr_f") == ["ppo.lr_final="]
    assert offers("mappo-train --conf") == ["--config"]
    assert offers("mappo-eval env=W") == ["Walker", "WallJump"]
    assert offers("mappo-export recipe") == []
    assert offers("mappo-search trials") == ["trials="]
    assert offers("mappo-search ppo.lr_f") == ["ppo.lr_final="]
    assert offers("mappo-hub pu") == ["push", "pull"]
    assert offers("mappo-hub push priv") == ["private="]


@needs_bash
def test_bash_knows_every_option_of_training() -> None:
    options = {f"{key}=" for key, option in option_table(Config).items() if not option.is_section}
    assert len(options) > 100
    assert options <= set(offers("mappo-train "))


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_the_same_words(shell: str) -> None:
    script = completion.completion_script(shell)
    assert "env=WallJump" in script and "ppo.lr=" in script and "mappo-league" in script

    if shutil.which(shell):
        done = subprocess.run([shell, "-n"], input=script, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_the_switch_prints_the_script(capsys: pytest.CaptureFixture[str]) -> None:
    assert train_main(["--completion", "bash"]) == 0
    assert capsys.readouterr().out == completion.completion_script("bash")


def test_a_wrong_shell_and_hydras_switch_are_told_the_right_one(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="one of bash, zsh, fish"):
        completion.completion_script("tcsh")

    for lines in (["--completion"], ["-sc", "install=bash"], ["--shell-completion", "install=bash"]):
        assert train_main(lines) == 2
        assert "--completion bash" in capsys.readouterr().err


def test_the_script_needs_no_torch() -> None:
    code = (
        "import sys; from mappo_unity.cli import train_main; train_main(['--completion', 'bash']); "
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
