"""scripts/bench_peer.py: the player's own count of returns, the curves, the table, its messages."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest
import torch

from mappo_unity.envs.unity_env import UnityEnv

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import bench_peer
from recorded_player import EPISODES, recorded_scene


def test_the_player_counts_returns_as_the_trainer_does(tmp_path, monkeypatch):
    monkeypatch.setenv("PEER_SCENE", "DungeonEscape")
    monkeypatch.setenv("PEER_EPISODES", str(tmp_path / "episodes.csv"))
    torch.manual_seed(0)
    env = UnityEnv(recorded_scene)
    env.rollout(400, break_when_any_done=False)
    seen = [episode for episodes in env.pop_episodes().values() for episode in episodes]
    env.close()

    noted = bench_peer.episodes(tmp_path)
    assert len(noted) == len(seen) > 10
    returns = sorted(episode.individual_return + episode.group_return for episode in seen)
    assert sorted(value for _, value in noted) == pytest.approx(returns)
    decided_at = [at for at, _ in noted]
    assert decided_at == sorted(decided_at) and decided_at[-1] > 1000


def test_what_a_player_noted_outlasts_the_next_one(tmp_path, monkeypatch):
    monkeypatch.setenv("PEER_SCENE", "Basic")
    monkeypatch.setenv("PEER_EPISODES", str(tmp_path / EPISODES))
    torch.manual_seed(0)
    players = [UnityEnv(recorded_scene) for _ in range(3)]
    for env in players[:2]:  # nobody plays the third
        env.rollout(300, break_when_any_done=False)
    for env in players:
        env.close()

    first, second = ((tmp_path / name).read_text().splitlines() for name in (EPISODES, "episodes_1.csv"))
    assert first and second
    noted = bench_peer.episodes(tmp_path)
    assert len(noted) == len(first) + len(second)
    at = [int(line.partition(",")[0]) for line in first]
    at += [at[-1] + int(line.partition(",")[0]) for line in second]  # it counts on
    assert [decisions for decisions, _ in noted] == at


def write(out: Path, trainer: str, seed: int, episodes: list[tuple[int, float, float]]) -> None:
    folder = out / f"{trainer}-{seed}"
    folder.mkdir()
    with open(folder / "episodes.csv", "w", newline="") as file:
        csv.writer(file).writerows(episodes)
    row = {"scene": "Basic", "trainer": trainer, "seed": seed, "limit": 300, "last_return": 1.5}
    row |= {"seconds": 7, "load_before": 1.0, "load_after": 2.0, "date": "-", "folder": folder}
    bench_peer.append(out / "results.csv", row)


def test_curves_and_table(tmp_path):
    write(tmp_path, "mlagents-learn", 0, [(5, 1, 0), (9, 2, 1), (150, 4, 0), (300, 9, 9)])
    write(tmp_path, "mappo-unity", 0, [(280, 1, 0), (295, 2, 0)])
    curves = bench_peer.write_curves(tmp_path, tmp_path / "peer.csv")
    assert curves["Basic", "mlagents-learn", 0] == [(25, 2.0), (175, 4.0)]  # 12 points of 25 decisions
    assert (tmp_path / "peer.csv").read_text().splitlines()[1] == "Basic,mlagents-learn,0,25,2"
    assert bench_peer.last_return(tmp_path / "mappo-unity-0", 300) == 1.5
    assert (
        bench_peer.table(tmp_path).splitlines()[2] == "| Basic | 300 | 0 | 1.5 | 1.5 | 7 | 7 | 1.0 to 2.0 |"
    )


def test_the_picture_says_what_it_needs(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SystemExit, match="pip install matplotlib"):
        bench_peer.draw({}, tmp_path / "peer.png")
