"""The trained policies that the package brings."""

import csv
import json
import shutil

import onnx
import pytest

from mappo_unity.cli import eval_main, play_main
from mappo_unity.policies.onnx_policy import OnnxFolder
from mappo_unity.policies.policy_files import ZOO_FOLDER, Kind, locate
from mappo_unity.scenes.registry import make_scene

with open(ZOO_FOLDER / "zoo.csv", newline="") as file:
    CARDS = list(csv.DictReader(file))


def test_every_file_has_a_card_and_is_small():
    assert {path.stem for path in ZOO_FOLDER.glob("*.onnx")} == {card["behavior"] for card in CARDS}
    assert all(path.stat().st_size <= 1_500_000 for path in ZOO_FOLDER.glob("*.onnx"))


@pytest.mark.parametrize("card", CARDS, ids=lambda card: card["behavior"])
def test_a_file_plays_its_scene(card):
    policy = OnnxFolder(ZOO_FOLDER, deterministic=False)
    env = make_scene(card["scene"], num_areas=8)  # of one wall alone WallJump begins with a big one
    env.reset()

    for name in env.behavior_specs:
        if name.split("?")[0] == card["behavior"]:
            spec = env.behavior_specs[name]
            policy.check(name, spec)
            decision, _ = env.get_steps(name)
            assert len(decision), "nothing is played"
            env.set_actions(name, policy.act(name, decision, spec))
            env.step()
            break
    else:
        pytest.fail(f"{card['scene']} has no behavior {card['behavior']}")
    env.close()


def test_a_file_that_takes_one_agent_at_a_time_is_told(tmp_path, capsys):
    model = onnx.load(str(ZOO_FOLDER / "Basic.onnx"))
    for entry in model.graph.input:
        entry.type.tensor_type.shape.dim[0].dim_value = 1
    onnx.save(model, str(tmp_path / "one.onnx"))
    assert eval_main([f"run={tmp_path / 'one.onnx'}", "env=Basic", "episodes=4"]) == 2
    assert "one.onnx cannot play 16 agents of 'Basic?team=0' at once: " in capsys.readouterr().err


def test_zoo_evaluates_as_its_card_says(capsys):
    assert eval_main(["run=zoo", "env=Basic", "episodes=20"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["mean_return"] == pytest.approx(0.93, abs=1e-6)  # the most that Basic pays
    assert said["policy"] == "zoo"


def test_a_folder_of_the_users_named_zoo_is_named_by_its_path(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "zoo").mkdir()
    (tmp_path / "zoo" / "Own.onnx").write_bytes(b"")

    assert locate("zoo", "run").path == ZOO_FOLDER
    assert locate("./zoo", "run").path != ZOO_FOLDER
    assert locate("./zoo", "run").kind is Kind.onnx_folder

    shutil.copy(ZOO_FOLDER / "Basic.onnx", tmp_path / "zoo")
    assert eval_main(["run=./zoo", "env=Basic", "episodes=1"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["policy"] == "./zoo"


def test_a_scene_without_a_file_in_the_zoo(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("mappo_unity.policies.policy_files.ZOO_FOLDER", tmp_path)
    assert eval_main(["run=zoo", "env=Basic"]) == 2
    assert "'Basic?team=0' needs a file" in capsys.readouterr().err


def test_the_environment_must_be_said(capsys):
    assert eval_main(["run=zoo"]) == 2
    assert "say in which environment to play it: env=NAME" in capsys.readouterr().err
    assert play_main(["policy=zoo"]) == 2
    assert "env" in capsys.readouterr().err
