"""scripts/race_peer.py: matches of what three trainers saved, their table, the official file it takes."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import race_page
import race_peer
from peer_command import their_command

MEASURES = ("won_of_decided", "won_of_decided_low95", "won_of_decided_high95")
"""What an evaluation says about matches."""


@pytest.fixture
def arguments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> argparse.Namespace:
    """Return the arguments of a race of SoccerTwos whose three runs lie in a folder."""
    for module in (race_page, race_peer):
        monkeypatch.setattr(module, "MATCHES", tmp_path / "race_matches.csv")
    arguments = argparse.Namespace(out=tmp_path, who=race_page.NAMES)
    for who in (race_peer.PEER, race_peer.PLAYER, race_peer.EMBEDDED):
        run = race_peer.folder_of(arguments, "SoccerTwos", 0, who, 10.0) / "run"
        run.mkdir(parents=True)
        if who == race_peer.PEER:
            (run.parent / "episodes.csv").write_text("40,0,1,5.0\n250000,0,1,9.0\n")
        else:
            (run / "metrics.csv").write_text("agent_steps,return_mean\n100,0\n500000,1\n")
    return arguments


def test_what_was_saved_plays_random_players_and_the_peer_once(arguments, monkeypatch):
    played: list[tuple[str, ...]] = []

    def evaluate(*words: str) -> dict[str, Any]:
        played.append(words)
        won = 0.9 if "opponent=random" in words else 0.75
        return {
            "won_of_decided": won,
            "won_of_decided_low95": won - 0.04,
            "won_of_decided_high95": won + 0.04,
        }

    monkeypatch.setattr(race_peer, "mappo_eval", evaluate)
    race_peer.play_matches(arguments, "SoccerTwos", 0, 10.0)
    theirs = arguments.out / "SoccerTwos-mlagents-learn-0-10/run/SoccerTwos.onnx"
    ours = [arguments.out / f"SoccerTwos-preset_{how}-0-10/run" for how in ("through_the_player", "embedded")]
    wanted = [(theirs, "random"), *((run, against) for run in ours for against in ("random", theirs))]
    assert [words[0::2][:2] for words in played] == [(f"run={run}", f"opponent={a}") for run, a in wanted]

    lines = race_page.matches_table()
    ours_cell = "90.0 % (2.0), 0.50 M"
    assert lines[3] == f"| SoccerTwos | 0 | 10 | random | 90.0 % (2.0), 0.25 M | {ours_cell} | {ours_cell} |"
    assert lines[4].startswith("| SoccerTwos | 0 | 10 | mlagents-learn | - | 75.0 % (2.0), 0.50 M |")

    race_peer.play_matches(arguments, "SoccerTwos", 0, 10.0)
    assert len(played) == 5, "what stands in the file is not played again"

    lines = race_peer.MATCHES.read_text().splitlines(keepends=True)
    race_peer.MATCHES.write_text("".join(lines[:-1]))  # interrupted before the last
    race_peer.play_matches(arguments, "SoccerTwos", 0, 10.0)
    assert played[5:] == played[4:5]


def test_pyramids_is_raced_with_the_official_rnd(tmp_path):
    for name in ("Pyramids", "PyramidsRND"):
        (tmp_path / "ppo").mkdir(exist_ok=True)
        (tmp_path / "ppo" / f"{name}.yaml").write_text(yaml.safe_dump({"behaviors": {name: {}}}))
    arguments = argparse.Namespace(official=tmp_path, peer=Path("mlagents-learn"))
    their_command(arguments, "Pyramids", 0, 1000, tmp_path / "player", tmp_path)
    configuration = yaml.safe_load((tmp_path / "configuration.yaml").read_text())
    assert configuration == {"behaviors": {"PyramidsRND": {"max_steps": 1000}}}


def curve(limit: float, seconds: float, *points: tuple[float, float]) -> list[dict[str, str]]:
    """Return the rows of one trainer: (second, return), its time and what it had of it."""
    facts = {"limit": str(limit), "seconds": str(seconds), "load": "1.0-1.0"}
    return [{"second": str(at), "return": str(value)} | facts for at, value in points]


def test_the_peer_may_train_on_after_the_minutes_that_are_compared():
    by_who = {
        race_page.PEER: curve(600, 600, (50, -0.2), (120, 0.1), (500, 0.6)),
        race_page.PLAYER: curve(120, 120, (30, 0.4), (60, 0.75), (119, 0.9)),
        race_page.EMBEDDED: curve(120, 40, (20, 0.7), (40, 0.95)),
    }
    row = race_page.race_row("Hallway", "0", by_who)
    assert row == "| Hallway | 0 | 2 | 0.1 | 0.9 | 0.95 | 0.7: > 600, 60, 20 | > 10.0, > 30.0 | 1.0-1.0 |"

    by_who[race_page.PEER] = curve(600, 600, (50, -0.2), (500, 0.8))
    by_who[race_page.PLAYER] = curve(120, 90, (90, 0.5))  # made all its decisions
    row = race_page.race_row("Hallway", "0", by_who)
    assert "| 0.7: 500, -, 20 | -, 25.0 |" in row

    by_who[race_page.PEER] = curve(600, 400, (50, -0.2), (400, 0.6))
    assert "| 0.7: -, -, 20 | -, - |" in race_page.race_row("Hallway", "0", by_who)


@pytest.mark.parametrize("word", ["0.5", "nan", "inf", "-1", "twice", ""])
def test_patience_is_a_number_of_at_least_one(word):
    assert race_peer.patience_of("1.6") == 1.6
    with pytest.raises(argparse.ArgumentTypeError, match="must be a number of at least 1"):
        race_peer.patience_of(word)


@pytest.mark.parametrize(
    "word", ["Basic", "Basic=", "Basic=0", "Basic=nan", "Basic=-3", "Basic=soon", "Basic=inf"]
)
def test_a_scene_comes_with_its_minutes(word):
    assert race_peer.minutes_of("Basic=3") == ("Basic", 3.0)
    with pytest.raises(argparse.ArgumentTypeError, match="must be SCENE=MINUTES, such as 3DBall=3"):
        race_peer.minutes_of(word)


def test_embedded_returns_stand_at_the_seconds_when_they_were_written_down(tmp_path):
    from torch.utils.tensorboard import SummaryWriter

    run = tmp_path / "run"
    run.mkdir()
    with SummaryWriter(str(run / "tensorboard")) as writer:
        for at_s, steps, value in ((1005.0, 100, 0.1), (1007.5, 200, 0.5), (1009.0, 300, 0.9)):
            writer.add_scalar("return_mean", value, steps, walltime=at_s)
    (run / "metrics.csv").write_text(
        "agent_steps,wall_s,episodes,return_mean\n100,1,40,0.1\n200,3.5,120,0.5\n300,5,180,0.9\n"
    )

    # the first has too few episodes for a mean; what comes after the last row is not counted
    curve = race_peer.embedded_curve(tmp_path, 1000.0)
    assert curve == [(7.5, 200, 0.5), (9.0, 300, 0.9)]


def test_one_may_train_alone_for_minutes_of_its_own(arguments, monkeypatch):
    played: list[str] = []
    monkeypatch.setattr(
        race_peer,
        "mappo_eval",
        lambda *words: played.append(words[0]) or dict.fromkeys(MEASURES, 0.6),
    )
    race_peer.play_matches(arguments, "SoccerTwos", 0, 10.0)
    assert len(played) == 5
    assert race_peer.is_known("SoccerTwos", 0, race_peer.PEER, 10.0)
    assert not race_peer.is_known("SoccerTwos", 0, race_peer.PEER, 42.0)

    arguments.who = [race_peer.PEER]
    longer = race_peer.folder_of(arguments, "SoccerTwos", 0, race_peer.PEER, 42.0)
    longer.mkdir()
    (longer / "episodes.csv").write_text("40,0,1,5.0\n900000,0,1,9.0\n")
    race_peer.play_matches(arguments, "SoccerTwos", 0, 42.0)
    assert played[5:] == [f"run={longer / 'run/SoccerTwos.onnx'}"], "nobody else has trained for so long"
    row = "| SoccerTwos | 0 | 42 | random | 60.0 % (0.0), 0.90 M | - | - |"
    assert row in race_page.matches_table()
