"""Bad inputs of rewards, demonstrations, environment parameters, encoders and warm starts, given as users do.

Each ends with exit code 2 and one line that names the option or file and the value. There are 52 here;
44 more of the kind stand in test_rewards (9), test_imitation (9), test_warm_start (16), test_play (5),
test_lessons (3) and test_sensors (2), and are not repeated.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from mappo_unity.cli import eval_main, play_main, train_main

COMMANDS = {"train": train_main, "eval": eval_main, "play": play_main}
TINY = ["max_steps=200", "collect.batch_size=200", "model.hidden=[8]", "log.progress=false", "log.loggers=[]"]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings, two runs of Basic, one with GAIL, one a clone, and damaged files."""
    folder = tmp_path_factory.mktemp("place")
    basic = folder / "basic.demo"
    assert play_main(["env=Basic", f"record={basic}", "seconds=20"]) == 0
    assert play_main(["env=Basic", f"record={folder}/short.demo", "seconds=3"]) == 0
    assert play_main(["env=3DBall", f"record={folder}/ball.demo", "seconds=4"]) == 0

    gail = ["rewards.gail.strength=0.1", f"rewards.gail.demos=[{basic}]"]
    for name, teachers in (("gail", gail), ("clone", ["bc.only=true", f"bc.demos=[{basic}]"])):
        run = ["env=Basic", *TINY, "export_onnx=false", *teachers, f"hydra.run.dir={folder}/{name}"]
        assert train_main(run) == 0

    (folder / "empty.demo").touch()
    (folder / "empty.onnx").touch()
    (folder / "cut.demo").write_bytes(basic.read_bytes()[:-50])
    (folder / "text.demo").write_text("no demonstration, but words " * 9)
    (folder / "cut.pt").write_bytes((folder / "gail/checkpoints/best.pt").read_bytes()[:-300])
    (folder / "nothing").mkdir()
    (folder / "mixed").mkdir()
    for name in ("basic.demo", "ball.demo"):
        (folder / "mixed" / name).write_bytes((folder / name).read_bytes())
    (folder / "my.yaml").write_text("rewards: {curiosity: {strength: -1}}\n")
    return folder


ONLY = "bc.only=true bc.demos=[basic.demo]"
GAIL = "rewards.gail.strength=0.1 rewards.gail.demos=[basic.demo]"
MASS = "train env=3DBall env.params.mass"
LESSONS = "{lessons: [{value: 1, completion: {%s}}, {value: 2}]}"

TOLD = [
    # demonstrations
    ("train env=Basic bc.demos=[empty.demo]", "demonstration empty.demo is empty"),
    ("train env=Basic bc.demos=[text.demo]", "text.demo is no demonstration of ML-Agents: its header"),
    ("train env=Basic bc.only=true bc.demos=[cut.demo]", "cut.demo is cut short: it should have"),
    ("train env=Basic bc.demos=[nothing]", "folder nothing holds no demonstration"),
    ("train env=Basic bc.demos=[mixed]", "mixed/ball.demo and mixed/basic.demo cannot be joined"),
    ("train env=Basic bc.demos=[clone/checkpoints/best.pt]", "best.pt is no demonstration of ML-Agents"),
    ("train env=Basic bc.demos=basic.demo", "bc.demos=basic.demo does not fit: bc.demos must be a list"),
    ("train env=Basic bc.only=maybe bc.demos=[basic.demo]", "bc.only=maybe does not fit: bc.only must be tr"),
    (f"train env=Basic {GAIL.replace('basic', 'empty')}", "demonstration empty.demo is empty"),
    (f"train env=Basic {GAIL.replace('basic', 'ball')}", "ball.demo does not fit the behavior 'Basic'"),
    # cloning
    ("train env=Basic bc.strength=0.5", "bc.strength=0.5 has no effect without bc.demos: give bc.demos=["),
    (
        "train env=SoccerTwos bc.demos=[x.demo] model.share_parameters=false",
        "bc.demos=[x.demo] of SoccerTwos",
    ),
    ("train env=Basic behaviors.Basic.bc.only=true", "behaviors.Basic.bc.only=true has no effect"),
    ("train env=Basic behaviors.Basic.bc.steps=-1", "behaviors.Basic.bc: bc.steps=-1 is out of range"),
    ("train env=Basic behaviors.Basic.bc.demos=x.demo", "behaviors.Basic.bc.demos=x.demo does not fit"),
    (
        "train env=WallJump bc.only=true behaviors.SmallWallJump.bc.demos=[x.demo]",
        "demonstration x.demo does not exist",
    ),
    (
        "train env=Basic bc.only=true behaviors.Other.bc.demos=[basic.demo]",
        "bc.only=true, but Basic has no demonstrations: behaviors.Basic.bc.demos=[expert.demo]",
    ),
    (
        f"train env=Basic {ONLY} rewards.rnd.strength=0.1",
        "rewards.rnd.strength=0.1 has no effect with bc.onl",
    ),
    (f"train env=Basic {ONLY} stop_at_return=1", "stop_at_return=1 does not go with bc.only=true"),
    (
        f"train env=Basic {ONLY} ppo.critic_warmup_steps=9",
        "ppo.critic_warmup_steps=9 has no effect with bc.only=true",
    ),
    (
        f"train env=Basic {ONLY} matches.interval=9",
        "matches.interval=9: matches need an environment with two",
    ),
    (
        f"train env=3DBall {ONLY} env.params.mass={LESSONS % 'threshold: 1'}",
        "env.params.mass has lessons, which do not go with bc.only=true",
    ),
    ("train resume=clone max_steps=900 bc.only=false", "bc.only=false cannot change with resume"),
    ("train resume=clone max_steps=900 bc.demos=[short.demo]", "demonstrations of Basic?team=0 that were"),
    # rewards
    (
        "train env=Basic rewards.gail.demos=[basic.demo]",
        "rewards.gail.demos=[basic.demo] has no effect witho",
    ),
    ("train env=Basic rewards.rnd.lr=0.01", "rewards.rnd.lr=0.01 has no effect without rewards.rnd.strength"),
    ("train env=Basic rewards.extrinsic.strength=0", "rewards.extrinsic.strength=0 leaves Basic nothing"),
    (
        "train env=Basic rewards.rnd.strength=0.1 rewards.rnd.steps=-1",
        "rewards.rnd.steps=-1 is out of range: rewards.rnd.steps must be >= 0",
    ),
    ("train env=Basic rewards.rnd.strength=much", "rewards.rnd.strength=much does not fit"),
    ("train env=Basic rewards.gail.strength=nan", "rewards.gail.strength=nan is out of range"),
    ("train env=Basic rewards.curiosity.normalize=no", "rewards.curiosity.normalize=no does not fit"),
    ("train env=Basic rewards=[curiosity]", "rewards=[curiosity]: rewards is a section; its options"),
    (
        "train env=Basic rewards.curiosity.strength=0.1 rewards.curiosity.hidden=[10000000000]",
        "rewards.curiosity.hidden=[10000000000]: learning its model for Basic",
    ),
    (
        "train env=Basic behaviors.Basic.rewards.rnd=3",
        "behaviors.Basic.rewards.rnd=3: rewards.rnd is a section",
    ),
    ("train env=Basic behaviors.Basic.rewards.rnd.lr=x", "behaviors.Basic.rewards.rnd.lr=x does not fit"),
    ("train --config my.yaml", "rewards.curiosity.strength=-1.0 is out of range"),
    (
        "train resume=gail max_steps=900 rewards.gail.hidden=[7]",
        "rewards.gail of Basic: what makes its layers",
    ),
    (
        "train resume=gail max_steps=900 rewards.gail.use_vail=true",
        "here hidden=[128,128], use_actions=false, u",
    ),
    # environment parameters
    (f"{MASS}={{sampler: uniform, min: 10, max: 1}}", "env.params.mass.min=10 must not be above max=1"),
    (
        f"{MASS}={{sampler: uniform, min: -3, max: 1}}",
        "parameter mass of scene 3DBall is out of range: what un",
    ),
    (f"{MASS}={{min: 1}}", "parameter mass={min: 1} of scene 3DBall must be a finite number"),
    (f"{MASS}={LESSONS % 'behavior: Nobody'}", "completion.behavior=Nobody: the environment has no such beh"),
    (
        f"{MASS}={LESSONS.replace('value: 2', 'value: -2') % 'threshold: 1'}",
        "parameter mass=-2.0 of scene 3D",
    ),
    ("train env=Basic parameters=WallJump_curriculum", "scene Basic has no parameter 'big_wall_height'"),
    ("train env=3DBall parameters=Nope", "parameters=Nope does not exist"),
    # encoders, warm starts, files
    ("train env=GridFoodCollector model.image_encoder=simpel", "model.image_encoder=simpel does not fit"),
    ("train env=Basic init_from=empty.onnx", "empty.onnx is no ONNX model that can be read: it is empty"),
    ("train env=Basic init_from=cut.pt", "checkpoint cut.pt is damaged or no checkpoint"),
    ("train env=Basic init_from=basic.demo", "init_from=basic.demo is neither a checkpoint nor an ONNX file"),
    # recordings and evaluations
    ("play env=Basic record=text.demo/x.demo", "recording text.demo/x.demo cannot be written"),
    ("play run=clone env=3DBall record=x.demo", "run=clone cannot play '3DBall?team=0': it holds the policy"),
    ("eval run=clone rewards.rnd.strength=1", "rewards.rnd.strength is an option of mappo-train, not of"),
    ("eval run=clone env.params.x={sampler: uniform, min: 3}", "env.params.x.min=3 must not be above max=1"),
]


@pytest.mark.parametrize(("line", "words"), TOLD, ids=[line for line, _ in TOLD])
def test_a_bad_input_is_told_in_one_line(
    line: str, words: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    command, *options = _words(line)
    is_new = command == "train" and not any(word in line for word in ("resume=", "onnx"))
    small = [*TINY, "output_dir=runs"] if is_new else []
    assert COMMANDS[command]([*options, *small]) == 2

    err = capsys.readouterr().err
    assert words in err and err.startswith(f"mappo-{command}: ") and err.count("\n") == 1
    assert not (place / "runs").exists() and not (place / "outputs").exists()


def _words(line: str) -> list[str]:
    """Cut a command line at its spaces, but for those within braces."""
    words, depth = [""], 0
    for letter in line:
        depth += (letter == "{") - (letter == "}")
        if letter == " " and not depth:
            words.append("")
        else:
            words[-1] += letter
    return words


def test_a_start_that_fits_no_layer_is_refused_with_its_table(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    assert train_main(["env=3DBall", "init_from=clone", *TINY, "output_dir=runs"]) == 2
    first, *table = capsys.readouterr().err.splitlines()
    assert first.startswith("mappo-train: init_from=clone: no layer of it fits the actor of 3DBall")
    # a bias has the right size by chance
    assert [row.split()[:2] for row in table if "copied" in row][0] == ["copied", "actor.net.0.bias"]
