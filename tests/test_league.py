"""Leagues: the schedule, resuming, what is written, and a small real one."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import shutil
import signal
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import pytest

from mappo_unity.cli import league_main
from mappo_unity.config.compose import compose_config, compose_plain
from mappo_unity.config.plain_options import take_words
from mappo_unity.config.schema import Backend, EnvConfig, LeagueConfig
from mappo_unity.errors import ConfigError
from mappo_unity.policies.league import play
from mappo_unity.policies.league.checks import League, Player, check_league, check_unchanged, digest_of
from mappo_unity.policies.league.play import play_league, tasks_of
from mappo_unity.policies.league.report import write_report
from mappo_unity.policies.league.table import MATCHES, pairs_of
from mappo_unity.policies.league.words import short_names
from mappo_unity.policies.policy_files import ZOO_FOLDER
from mappo_unity.runs.folder import write_record
from mappo_unity.runs.lock import locked
from mappo_unity.signals import Interrupted
from mappo_unity.training.trainer import train

NAMES = ("a <b>", "b & c", "random")
DUEL = EnvConfig(name="Duel", backend=Backend.custom, factory="test_matches:Duel")
FILES = ("matches.csv", "league.csv", "league.svg", "league.html", "league.json")


def league_in(folder: Path, matches: int = 10, seed: int = 3) -> League:
    """Return a league of three who all choose at random, each with numbers of its own."""
    players = tuple(Player(name, "random", name) for name in NAMES)
    return League(players, DUEL, matches, False, seed, folder)


def play_all(league: League, workers: int = 1, stop_after: int | None = None) -> list[tuple[str, str]]:
    """Play what is left and write the report; return the pairs that were played."""
    played = []

    def told(pair: tuple[str, str], results: list, done: int, total: int) -> None:
        played.append(pair)
        assert total == 3 and sum(row.won + row.drawn + row.lost for row in results) == league.matches
        if done == stop_after:
            raise KeyboardInterrupt

    write_report(league, play_league(league, workers, told))
    return played


def files_of(folder: Path) -> list[bytes]:
    return [(folder / name).read_bytes() for name in FILES]


def test_a_league_that_was_cut_off_goes_on_to_the_same_end(tmp_path: Path) -> None:
    whole, cut = league_in(tmp_path / "whole"), league_in(tmp_path / "cut")
    assert play_all(whole) == pairs_of(NAMES)

    with pytest.raises(KeyboardInterrupt):
        play_all(cut, stop_after=1)
    assert sorted(path.name for path in cut.folder.iterdir()) == [".lock", "league.json", MATCHES]
    assert play_all(cut) == pairs_of(NAMES)[1:]
    assert files_of(whole.folder) == files_of(cut.folder)
    assert play_all(cut) == []  # nothing is left to play; the report is written again
    assert files_of(whole.folder) == files_of(cut.folder)


@pytest.mark.slow
def test_processes_change_nothing_and_seeds_do(tmp_path: Path) -> None:
    one, two, other = league_in(tmp_path / "1"), league_in(tmp_path / "2"), league_in(tmp_path / "3", seed=4)
    play_all(one)
    assert sorted(play_all(two, workers=2)) == sorted(pairs_of(NAMES))
    assert files_of(one.folder) == files_of(two.folder)
    play_all(other)
    assert (one.folder / MATCHES).read_bytes() != (other.folder / MATCHES).read_bytes()
    seeds = [seed for task in tasks_of(one) for seed in task.seeds]
    assert len(set(seeds)) == 9


def test_a_process_that_fails_says_why_and_leaves_what_was_played(tmp_path: Path) -> None:
    league = league_in(tmp_path / "league")
    gone = replace(league, players=(*league.players[:2], Player("random", "gone.onnx", "")))
    with pytest.raises(ConfigError, match="run=gone.onnx does not exist"):
        play_league(gone, 2, lambda *args: None)


def test_processes_that_wait_for_a_pair_end_without_a_word(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyboardInterrupt), play._processes(1) as pool:
        pid = pool.submit(os.getpid).result()
        (child,) = [child for child in multiprocessing.active_children() if child.pid == pid]
        child.terminate()
        child.join(60)
        raise KeyboardInterrupt
    assert child.exitcode == 128 + signal.SIGTERM and capfd.readouterr().err == ""


def test_a_pair_that_is_told_to_end_closes_what_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    def told_twice(task: play.Task) -> list:
        with pytest.raises(Interrupted):
            play._stop(signal.SIGTERM, None)
        play._stop(signal.SIGTERM, None)
        return []

    monkeypatch.setattr(play, "_stopped", False)
    monkeypatch.setattr(play, "_play", told_twice)
    assert play.play_pair(None) == [] and play._stopped  # type: ignore[arg-type]


def test_what_is_written(tmp_path: Path) -> None:
    league = league_in(tmp_path / "league")
    play_all(league)

    rows = list(csv.DictReader((league.folder / "league.csv").open(encoding="utf-8")))
    assert list(rows[0]) == ["name", "rating", "low", "high", "won", "drawn", "lost"]
    assert {row["name"] for row in rows} == set(NAMES)
    assert [float(row["rating"]) for row in rows] == sorted(
        (float(row["rating"]) for row in rows), reverse=True
    )
    random = next(row for row in rows if row["name"] == "random")
    assert random["rating"] == random["low"] == random["high"] == "1200.0"
    assert all(int(row["won"]) + int(row["drawn"]) + int(row["lost"]) == 20 for row in rows)

    picture = ElementTree.parse(league.folder / "league.svg").getroot()
    assert len(picture.findall(".//{*}circle")) == 3 and len(picture.findall(".//{*}title")) == 3 + 6
    html = (league.folder / "league.html").read_text(encoding="utf-8")
    assert "a &lt;b&gt;" in html and "<b>" not in html and "prefers-color-scheme: dark" in html
    assert "width=device-width" in html
    assert not [word for word in ("src=", "href=", "url(", "@import", "<script") if word in html]


def test_a_folder_belongs_to_one_league(tmp_path: Path) -> None:
    league = league_in(tmp_path / "league")
    play_all(league)
    (league.folder / MATCHES).write_text("policy,opponent\nx,y\n")
    with pytest.raises(ConfigError, match=r"matches.csv is no table of results any more.*delete it"):
        play_all(league)
    with (
        locked(league.folder),
        pytest.raises(ConfigError, match="is being played by another process"),
    ):
        play_all(league)


def test_a_league_that_is_refused_leaves_the_other_s_record_alone(tmp_path: Path) -> None:
    """Two that begin at once both find an empty folder."""
    one, other = league_in(tmp_path / "league"), league_in(tmp_path / "league", seed=4)
    one.folder.mkdir()
    with locked(one.folder), pytest.raises(ConfigError, match="is being played by another process"):
        play_all(other)
    assert not (one.folder / "league.json").exists()

    play_all(one)
    before = files_of(one.folder)
    with pytest.raises(ConfigError, match="holds another league, which differs in seed"):
        play_all(other)
    assert files_of(one.folder) == before


def test_a_policy_that_is_replaced_while_the_league_plays_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "best.onnx"
    shutil.copy(ZOO_FOLDER / "SoccerTwos.onnx", file)
    player = Player("best", str(file), digest_of(str(file)))
    league = League((player, *league_in(tmp_path).players), DUEL, 2, False, 0, tmp_path / "league")
    league = replace(league, env=EnvConfig(name="SoccerTwos", num_areas=1))

    def replaced(*told: object) -> None:
        shutil.copy(ZOO_FOLDER / "Striker.onnx", file)

    with pytest.raises(
        ConfigError, match="policy best has changed since the league began: .*best.onnx is not"
    ):
        play_league(league, 1, replaced)
    assert len((league.folder / MATCHES).read_text().splitlines()) == 1 + 2  # the pair before it counts
    file.unlink()
    with pytest.raises(ConfigError, match="policy best has changed"):
        check_unchanged(player)


def test_names_are_short_and_tell_the_players_apart() -> None:
    words = ["out/s/a", "random", "out/s/b/checkpoints/step_1.pt"]
    assert short_names(words) == ["a", "random", "step_1.pt"]
    assert short_names(["a/x/best.pt", "b/x/best.pt", "c/y/best.pt"]) == [
        "a/x/best.pt",
        "b/x/best.pt",
        "y/best.pt",
    ]
    assert short_names(["x/random", "y"]) == ["x/random", "y"]  # only the real random is called random
    assert short_names(["b", "a/b", "/run"]) == ["b", "a/b", "run"]
    here = Path.cwd().name
    assert short_names(["./zoo", "zoo", "random/", "random"]) == [
        f"{here}/zoo",
        "zoo",
        f"{here}/random",
        "random",
    ]
    assert short_names(["./zoo", "random"]) == ["zoo", "random"]


def test_a_folder_of_ones_own_is_not_the_package_s_zoo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("zoo", "random"):
        Path(name).mkdir()
        shutil.copy(ZOO_FOLDER / "SoccerTwos.onnx", name)
    shutil.copy(ZOO_FOLDER / "Goalie.onnx", "zoo")  # another digest than the other folder's
    league = check_league(LeagueConfig(["./zoo", "zoo", "./random", "random"], env="SoccerTwos"))
    assert [player.where for player in league.players] == [
        str(tmp_path / "zoo"),
        str(ZOO_FOLDER),
        str(tmp_path / "random"),
        "random",
    ]
    assert len({player.digest for player in league.players}) == len(set(league.names)) == 4


def test_words_before_the_options_are_the_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ppo.lr=1e-4,seed=0").mkdir()
    lines = take_words(["a, b/jürgen", "ppo.lr=1e-4,seed=0", "${x}", "matches=4"], LeagueConfig, "policies")
    cfg = compose_plain(lines, LeagueConfig)
    assert cfg.policies == ["a, b/jürgen", "ppo.lr=1e-4,seed=0", "${x}"] and cfg.matches == 4


def test_a_small_real_league(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = tmp_path / "run", tmp_path / "league"
    lines = ["env=SoccerTwos", "env.num_areas=1", "max_steps=64", "model.hidden=[8]", "matches.interval=null"]
    config = compose_config([*lines, "collect.batch_size=64", "ppo.minibatch_size=64"]).config
    write_record(run_folder(run), config, [])
    train(config, run)
    capsys.readouterr()

    words = [str(run), "random", str(run / "checkpoints" / "best.onnx")]
    assert league_main([*words, "matches=2", f"out={out}", "workers=1"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("1/3 pairs: ") and printed[-2] == str(out / "league.html")
    rows = json.loads(printed[-1])["league"]
    assert sum(row["won"] + row["drawn"] + row["lost"] for row in rows) == 3 * 2 * 2
    sides = [row["side"] for row in csv.DictReader((out / MATCHES).open())]
    assert sides == 3 * ["SoccerTwos?team=0", "SoccerTwos?team=1"]

    assert league_main([*words, "matches=4", f"out={out}"]) == 2
    assert "holds another league, which differs in matches" in capsys.readouterr().err
    # a pair's seeds are those of its place
    assert league_main([*words[::-1], "matches=2", f"out={out}"]) == 2
    assert "holds another league, which differs in its policies (" in capsys.readouterr().err
    assert len((out / MATCHES).read_text().splitlines()) == 1 + 3 * 2
    with pytest.raises(ConfigError, match=r"plays as .* and as .*best.pt: name each policy once"):
        check_league(LeagueConfig([str(run), str(run / "checkpoints" / "best.pt")]))


def run_folder(path: Path) -> Path:
    path.mkdir()
    return path


def test_sides_with_policies_of_their_own(tmp_path: Path) -> None:
    league = replace(
        league_in(tmp_path / "league", matches=2),
        players=(Player("one", "random", ""), Player("random", "random", "")),
        env=EnvConfig(name="StrikersVsGoalie", num_areas=1),
    )
    (rows,) = play_league(league, 1, lambda *args: None).values()
    assert [row.side for row in rows] == ["Striker?team=0", "Goalie?team=1"]
    assert rows[0].lost == 0 and rows[1].won == 0  # the goalie's side cannot score
    assert all(row.won + row.drawn + row.lost == 1 for row in rows)
