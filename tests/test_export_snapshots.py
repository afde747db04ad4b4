"""Exports of self-play's snapshots, which hold no observations of their own."""

import shutil

from test_self_play import matrix_game

from mappo_unity.cli import export_main
from mappo_unity.policies.onnx_policy import OnnxPolicy
from mappo_unity.runs.folder import write_record
from mappo_unity.training.trainer import train


def test_a_snapshot_of_self_play_is_compared_on_its_run_s_observations(tmp_path, capsys):
    run, out = tmp_path / "run", tmp_path / "snapshot.onnx"
    run.mkdir()
    write_record(run, matrix_game(3), [])
    train(matrix_game(3), run)
    snapshot = sorted((run / "pool").glob("step_*.pt"))[0]
    capsys.readouterr()
    assert export_main([f"run={snapshot}", f"out={out}"]) == 0
    assert "wall time | unknown" in (tmp_path / "snapshot.md").read_text(encoding="utf-8")
    assert OnnxPolicy(out, False).agent_steps == int(snapshot.stem.removeprefix("step_"))

    copied = shutil.copytree(run / "pool", tmp_path / "elsewhere" / "pool") / snapshot.name
    assert export_main([f"run={copied}", f"out={out}"]) == 2
    said = capsys.readouterr().err
    assert "holds no observations of 'Rps'" in said
    assert (
        f"is a snapshot of self-play, and no checkpoint of its run {copied.parent.parent} holds any" in said
    )
