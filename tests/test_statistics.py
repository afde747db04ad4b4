"""Statistics that environments report of themselves: from players, from custom environments, into the log."""

from __future__ import annotations

import csv
import logging
import os
import struct
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import reporting_env

from mappo_unity.cli import train_main
from mappo_unity.cli.player import run as player_main
from mappo_unity.config.schema import Backend, EnvConfig
from mappo_unity.envs.backends import make_env_function
from mappo_unity.envs.statistics import with_statistics
from mappo_unity.farama import session as farama
from mappo_unity.policies.episodes import play
from mappo_unity.policies.policy import RandomPolicy
from mappo_unity.protocol import side_channels
from mappo_unity.protocol.side_channels import TrainerChannels, statistics_messages
from mappo_unity.scenes.contract.statistics import AGGREGATIONS, join_statistics

TESTS = Path(__file__).resolve().parent
SMALL = [
    *("env=custom", "env.name=R", "env.factory=reporting_env:make", "model.hidden=[8]", "collect.rounds=4"),
    *("max_steps=32", "log.progress=false", "ppo.epochs=1", "export_onnx=false", "ppo.minibatch_size=16"),
]


@pytest.fixture
def player(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A built player of the environment that reports."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), str(TESTS.parent)]))
    assert player_main(["build", "reporting_env:make", str(tmp_path)]) == 0
    return str(tmp_path / "make")


def read_rows(folder: Path) -> list[dict[str, str]]:
    (metrics,) = folder.rglob("metrics.csv")
    return list(csv.DictReader(metrics.open()))


def test_a_custom_environments_statistics_are_logged_under_their_own_names(tmp_path: Path) -> None:
    assert train_main([*SMALL, f"output_dir={tmp_path}"]) == 0

    first, second = read_rows(tmp_path)
    # a batch is 4 rounds of 4 agents, a step each: 1 2 3 4, then 5 6 7 8
    assert [float(row["Game/mean"]) for row in (first, second)] == [2.5, 6.5]
    assert [float(row["Game/last"]) for row in (first, second)] == [4, 8]
    assert [float(row["Game/sum"]) for row in (first, second)] == [10, 26]
    assert [float(row["Game/spread"]) for row in (first, second)] == [2.5, 6.5]

    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    (folder,) = tmp_path.rglob("tensorboard")
    events = EventAccumulator(str(folder), size_guidance={"histograms": 0}).Reload()
    assert [event.value for event in events.Scalars("Game/sum")] == [10, 26]
    (one, two) = (event.histogram_value for event in events.Histograms("Game/spread_hist"))
    assert (one.num, one.min, one.max, two.sum) == (4, 1, 4, 26)
    assert "Game/mean_hist" not in events.Tags()["histograms"]


def test_a_players_statistics_arrive_and_player_0_has_the_last_word(player: str, tmp_path: Path) -> None:
    cfg = EnvConfig(
        backend=Backend.player, file_name=player, num_players=2, player_logs=str(tmp_path / "logs")
    )
    env: Any = make_env_function(cfg)(0)
    try:
        env.reset()
        assert env.pop_statistics() == {}
        for _ in range(3):
            for name in env.behavior_specs:
                spec = env.behavior_specs[name].action_spec
                env.set_actions(name, spec.random_action(len(env.get_steps(name)[0])))
            env.step()
        statistics = env.pop_statistics()
        row, histograms = with_statistics({}, statistics)
        assert row == {"Game/mean": 2.0, "Game/last": 3.0, "Game/sum": 12.0, "Game/spread": 2.0}
        assert sorted(histograms["Game/spread"].tolist()) == [1, 1, 2, 2, 3, 3]
        assert env.pop_statistics() == {}

        # what a player reported before it failed is not lost
        env.step()
        env.players[0]._statistics = env.players[0].pop_statistics()
        assert len(env.pop_statistics()["Game/sum"]) == 2
    finally:
        env.close()


def test_what_players_report_reaches_the_metrics_of_a_run(player: str, tmp_path: Path) -> None:
    lines = [*SMALL[3:], "env=unity", "env.name=P", f"env.file_name={player}", "log.loggers=[csv]"]
    assert train_main([*lines, f"output_dir={tmp_path / 'runs'}"]) == 0
    assert [float(row["Game/sum"]) for row in read_rows(tmp_path / "runs")] == [10, 26]


def test_nothing_piles_up_where_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    env = reporting_env.make(0)
    play(env, RandomPolicy(0), episodes=20)
    assert env.steps >= 5 and env.reported == {}

    monkeypatch.setattr(farama, "make_env_function", lambda cfg: reporting_env.make)
    session = farama.Session("3DBall", [], seed=0, num_areas=1)
    session.step({})
    assert session._env.steps == 1 and session._env.reported == {}

    # of an environment that came open somebody else may read them
    farama.Session(env, [], seed=0, num_areas=1).step({})
    assert len(env.reported["Game/sum"]) == 1


def test_the_bytes_are_those_of_mlagents() -> None:
    from mlagents_envs.side_channel.side_channel_manager import SideChannelManager
    from mlagents_envs.side_channel.stats_side_channel import StatsAggregationMethod, StatsSideChannel

    data = statistics_messages({"Tore über": [(1.5, "sum"), (2.0, "sum")], "x": [(0.0, "histogram")]})
    channel = StatsSideChannel()
    SideChannelManager([channel]).process_side_channel_message(data)
    how = StatsAggregationMethod
    want = {"Tore ?ber": [(1.5, how.SUM), (2.0, how.SUM)], "x": [(0.0, how.HISTOGRAM)]}
    assert dict(channel.get_and_reset_stats()) == want
    assert [method.name.lower() for method in how] == list(AGGREGATIONS)


def test_an_unknown_channel_is_said_once(caplog: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(side_channels, "_said_unknown", set())
    other = uuid.UUID("621f0a70-4f87-11ea-a6bf-784f4387d1f7")
    message = struct.pack("<i", 2) + b"hi"
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            channels = TrainerChannels({}, {}, [], seed=0)
            channels.process_side_channel_message((other.bytes_le + message) * 2)
            channels.process_side_channel_message(side_channels.ANALYTICS.bytes_le + message)
    assert [record.getMessage().count(str(other)) for record in caplog.records] == [1]


def test_names_that_would_do_harm_are_changed() -> None:
    row = {"agent_steps": 5, "return_mean": 1.0}
    statistics = {
        "return_mean": [(9.0, "average")],
        "../../up\n": [(1.0, "sum")],
        "empty": [],
        "nothing finite": [(float("nan"), "histogram")],
    }
    out, histograms = with_statistics(row, statistics)
    assert out["return_mean"] == 1.0 and out["environment/return_mean"] == 9.0
    assert out["up_"] == 1.0 and "empty" not in out and not histograms
    assert np.isnan(out["nothing finite"])


def test_joined_statistics_keep_their_order() -> None:
    parts = [{"a": [(1.0, "sum")]}, {"a": [(2.0, "sum")], "b": [(3.0, "sum")]}]
    assert join_statistics(parts) == {"a": [(1.0, "sum"), (2.0, "sum")], "b": [(3.0, "sum")]}


@pytest.mark.parametrize(
    ("broken", "code", "words"),
    [
        ("raises", 3, "its pop_statistics raised ZeroDivisionError"),
        ("text", 2, "pop_statistics()['Goals'] holds 'many'; it must be a list of pairs"),
        ("list", 2, "pop_statistics() returned a list; it must be a dict by name"),
    ],
)
def test_statistics_that_make_no_sense(
    broken: str, code: int, words: str, tmp_path: Path, capsys: Any
) -> None:
    assert train_main([*SMALL, f"env.params.broken={broken}", f"output_dir={tmp_path}"]) == code
    err = capsys.readouterr().err
    assert words in err and "site-packages" not in err


def test_an_environment_without_statistics_adds_no_column(tmp_path: Path) -> None:
    lines = [line for line in SMALL if not line.startswith("env.factory")]
    assert train_main([*lines, "env.factory=failing_env:make", f"output_dir={tmp_path}"]) == 0
    assert not [name for name in read_rows(tmp_path)[0] if "Game" in name]
