"""mappo-doctor run=FOLDER: faults are found, while training and afterwards, and sound runs have none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import faulty_env
import numpy as np
import pytest
import torch
from doctor_score import lines_of
from fakes import vector_spec
from mlagents_envs.base_env import ActionSpec, BehaviorSpec
from tensordict import TensorDict

from mappo_unity import keys
from mappo_unity.cli import doctor_main, report_main, train_main
from mappo_unity.diagnosis.diagnose import diagnose
from mappo_unity.diagnosis.evidence import Evidence
from mappo_unity.diagnosis.survey import RETURNS, PolicySurvey, Survey
from mappo_unity.diagnosis.survey_file import read_survey
from mappo_unity.envs.rounds import Episode
from mappo_unity.policies.layouts import describe_spec
from mappo_unity.reports.reading import Run, default_options, read_run

TIMELESS = [
    (fault, kind)
    for fault, kind in [
        *faulty_env.IN_THE_GAME.items(),
        *((fault, kind) for fault, (kind, *_) in faulty_env.IN_THE_OPTIONS.items()),
    ]
    if "slow" not in kind  # seconds are not what a test may depend on
]
QUICK = ["clipped", "same_for_all", "never_asked"]
"""Faults that show in a few thousand decisions, and that nothing else here has; the others are slow tests."""


def train(folder: Path, fault: str, *lines: str) -> list[str]:
    assert train_main([*lines_of(fault, *lines), f"hydra.run.dir={folder}"]) == 0
    return kinds(Evidence.of(read_run(folder)))


def kinds(evidence: Evidence) -> list[str]:
    return [finding.kind for finding in diagnose(evidence)]


# --- faults of a game


@pytest.mark.parametrize("fault", QUICK)
def test_a_fault_is_found(fault: str, tmp_path: Path, capsys: Any) -> None:
    assert faulty_env.IN_THE_GAME[fault] in train(tmp_path, fault, "max_steps=8192")
    finding = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("look: "))
    assert ("Other" if fault == "never_asked" else "Probe") in finding


def test_a_sound_run_has_no_finding(tmp_path: Path, capsys: Any) -> None:
    assert train(tmp_path, "") == []
    assert "look:" not in capsys.readouterr().out
    assert doctor_main([f"run={tmp_path}"]) == 0
    out = capsys.readouterr().out
    assert "30,720 of 30,000 decisions" in out and "nothing is found" in out and "decisions/s" in out


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "kind"), TIMELESS)
def test_every_fault_is_found(fault: str, kind: str, tmp_path: Path) -> None:
    train_main([*lines_of(fault), f"hydra.run.dir={tmp_path}"])  # one of them diverges
    assert kind in kinds(Evidence.of(read_run(tmp_path)))


def test_the_survey_counts_what_was_there(tmp_path: Path) -> None:
    train(tmp_path, "late_rewards", "max_steps=8192", "collect.batch_size=1024")
    facts = read_survey(tmp_path)["Probe"]
    assert facts["decisions"] == 8192 and facts["branches"] == [2] and facts["continuous"] == 0
    assert facts["vectors"] == [["heading", 1], ["gauge", 3]]

    # 32 agents, 256 rounds, episodes of 20: 12 whole ones each, whose only reward comes at the end
    assert facts["episodes"]["count"] == 32 * 12 == len(facts["returns"])
    assert facts["rewards"]["nonzero"] == facts["rewards"]["at_ends"] == 32 * 12
    assert facts["episodes"]["least"] == pytest.approx(min(facts["returns"]))
    assert 0 < min(facts["returns"]) < max(facts["returns"]) <= 1
    assert facts["slots"] == {"all": 0, "idle": 0}, "no agent was there for 500 rounds"

    heading = facts["elements"]["least"][0], facts["elements"]["greatest"][0]
    assert -1 <= heading[0] < -0.9 and 0.9 < heading[1] <= 1
    assert facts["elements"]["clipped"] == [] and facts["same_for_all"] is False


def test_a_resumed_run_is_surveyed_from_there(tmp_path: Path) -> None:
    train(tmp_path, "constant", "max_steps=4096")
    assert train_main([f"resume={tmp_path}", "max_steps=12288"]) == 0
    assert read_survey(tmp_path)["Probe"]["decisions"] == 8192


def test_agents_that_an_opponent_plays_are_not_idle(tmp_path: Path) -> None:
    lines = ["env=SoccerTwos", "env.num_areas=1", "model.hidden=[8]", "matches.interval=null", "ppo.epochs=1"]
    lines += ["self_play.save_steps=200", "self_play.play_against_latest_model_ratio=0", "max_steps=1400"]
    lines += ["self_play.team_change=100000", "collect.batch_size=200", f"hydra.run.dir={tmp_path}"]
    assert train_main(lines) == 0

    slots = read_survey(tmp_path)["SoccerTwos"]["slots"]
    assert slots == {"all": 2, "idle": 0}, "the two agents of the other team are asked as often"


# --- what metrics tell, with numbers made by hand


def run_of(options: dict[str, str] | None = None, **columns: Any) -> Run:
    """Return a finished run of 40 iterations of 1,000 decisions."""
    rows = 40
    usual: dict[str, Any] = {
        "agent_steps": np.arange(1, rows + 1) * 1000.0,
        "episodes": np.arange(1, rows + 1) * 100.0,
        "return_mean": np.linspace(0, 1, rows),
        "return_std": np.full(rows, 0.5),
        "episode_length_mean": np.full(rows, 20.0),
        "entropy": np.linspace(1.0, 0.5, rows),
        "entropy_coef": np.full(rows, 0.01),
        "kl": np.full(rows, 0.01),
        "clip_fraction": np.full(rows, 0.1),
        "explained_variance": np.linspace(0, 0.9, rows),
        "rolled_back": np.zeros(rows),
        "collect_s": np.full(rows, 0.1),
        "update_s": np.full(rows, 0.1),
    }
    made = {
        name: np.broadcast_to(np.asarray(value, float), rows) for name, value in (usual | columns).items()
    }
    known = default_options() | {"max_steps": "40000"} | (options or {})
    return Run(Path("nowhere"), known, made, {}, [], {})


FACTS: dict[str, Any] = {
    "branches": [3],
    "continuous": 0,
    "vectors": [["a", 2]],
    "decisions": 40_000,
    "rewards": {"count": 40_000, "nonzero": 40_000, "at_ends": 2000, "least": -1.0, "greatest": 1.0},
    "episodes": {"count": 2000, "of_one_decision": 0, "least": 0.0, "greatest": 1.0},
    "returns": [0.0, 1.0] * 500,
    "slots": {"all": 32, "idle": 0},
    "elements": {"least": [-1.0, -1.0], "greatest": [1.0, 1.0], "clipped": [], "clipped_share": 0.0},
    "images": {},
    "same_for_all": False,
    "one_action": 0.0,
    "never_allowed": [],
}


def found(
    facts: dict[str, Any] | None = None, options: dict[str, str] | None = None, **columns: Any
) -> list[str]:
    return kinds(Evidence(run_of(options, **columns), {"Probe": FACTS | (facts or {})}))


def test_a_return_must_have_risen_by_five_standard_errors() -> None:
    # half a unit of spread over 100 episodes: one error is 0.05
    assert found() == []
    flat = {"return_mean": np.r_[0.0, np.full(39, 0.24)]}
    assert found(**flat) == ["no rise"]
    assert found(return_mean=np.r_[0.0, np.full(39, 0.26)]) == []
    assert found(return_mean=np.r_[0.0, np.full(39, -0.26)]) == ["falls"]

    # returns that rise spread wider; a reward that is met by luck, late and once, is no rise
    rising = np.linspace(0, 40, 40)
    assert found(return_mean=rising, return_std=3 * rising) == []
    once = np.r_[np.zeros(36), np.full(4, 0.01)]
    assert found(return_mean=once, return_std=10 * once) == ["no rise"]


def test_nothing_is_judged_before_half_of_the_steps() -> None:
    assert found(options={"max_steps": "81000"}, return_mean=0.0) == []
    assert found(options={"max_steps": "80000"}, return_mean=0.0) == ["no rise"]


@pytest.mark.parametrize(
    ("kind", "columns"),
    [
        ("no steps", {"kl": 1e-8, "clip_fraction": 0.0}),
        ("entropy collapsed", {"entropy": 0.04}),  # of log 3 = 1.0986
        ("entropy stays", {"entropy": 1.09, "entropy_coef": 0.1}),
        ("values", {"explained_variance": 0.01}),
    ],
)
def test_an_update_that_goes_wrong_is_a_finding_where_the_return_stays(
    kind: str, columns: dict[str, Any]
) -> None:
    assert found(return_mean=0.0, **columns) == ["no rise", kind]
    assert found(**columns) == []


def test_continuous_actions_have_an_entropy_below_zero() -> None:
    facts = {"branches": [], "continuous": 2}
    assert found(facts, return_mean=0.0, entropy=np.linspace(2.8, -4.9, 40)) == ["no rise"]
    assert found(facts, return_mean=0.0, entropy=np.linspace(2.8, -6.0, 40)) == [
        "no rise",
        "entropy collapsed",
    ]
    # of the mean over columns
    mean = {"ppo.entropy": "mean"}
    assert "entropy collapsed" in found(facts, mean, return_mean=0.0, entropy=-2.6)
    assert "entropy stays" in found(facts, return_mean=0.0, entropy=2.8, entropy_coef=0.1)


def test_rollbacks_count_though_the_return_rises() -> None:
    assert found(rolled_back=np.r_[np.ones(9), np.zeros(31)]) == ["rollbacks"]
    assert found(rolled_back=np.r_[np.ones(8), np.zeros(32)]) == []


def test_with_two_sides_the_share_won_tells() -> None:
    assert found(return_mean=0.0, win_rate_vs_random=np.linspace(0.5, 0.9, 40)) == []
    assert found(return_mean=0.0, win_rate_vs_random=0.5) == ["no rise"]


def test_a_warm_start_and_lessons_need_not_rise() -> None:
    assert found(options={"init_from": "a.onnx"}, return_mean=0.0) == []
    assert found(options={"behaviors.Probe.init_from": "a.onnx"}, return_mean=0.0) == []
    assert found(return_mean=0.0, **{"lesson/size": np.arange(40) // 20}) == []


def test_rewards_at_the_end_want_a_gamma_that_sees_them() -> None:
    late = {"rewards": FACTS["rewards"] | {"nonzero": 2000}}
    assert found(late, {"ppo.gamma": "0.5"}) == ["short sight"]  # 0.5 ** 10
    assert found(late, {"ppo.gamma": "0.5"}, gamma=0.99) == []  # where its schedule has it by now
    assert found(late, {"ppo.gamma": "0.7"}) == []  # 0.7 ** 10 = 0.028
    own = "rewards.extrinsic.gamma"  # where it is given, the environment's rewards have it
    assert found(late, {"ppo.gamma": "0.5", own: "null"}) == ["short sight"]
    assert found(late, {"ppo.gamma": "0.5", own: "0.99"}) == []
    assert found(late, {"ppo.gamma": "0.99", own: "0.5"}) == ["short sight"]
    long = {"episode_length_mean": 1000.0}
    assert found(late, {"ppo.gamma": "0.99"}, **long) == []  # 0.0066, but it learns
    assert found(late, {"ppo.gamma": "0.99"}, return_mean=0.0, **long) == ["no rise", "short sight"]


def test_rare_rewards_and_equal_ones() -> None:
    rare = {"returns": [0.0] * 990 + [1.0] * 10}
    assert found(rare, return_mean=0.0) == ["no rise", "rare rewards"]
    assert found(rare) == []
    same = {"episodes": FACTS["episodes"] | {"greatest": 0.0}}
    assert found(same, return_mean=0.0) == ["equal returns", "no rise"]
    assert found(same) == [], "it had risen before the survey began"
    assert found(same, {"init_from": "zoo"}, return_mean=100.0) == [], "it knew all from the start"

    never = {"rewards": FACTS["rewards"] | {"nonzero": 0}}
    assert found(never | {"decisions": 20_000}) == ["no reward"]
    assert found(never | {"decisions": 19_999}) == [], "a resumed run: too early to say"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "rewards.rnd.strength=0.1"),
        ({"rewards.rnd.strength": "0.0"}, "rewards.rnd.strength=0.1"),
        ({"rewards.rnd.strength": "0.1"}, "novelty is rewarded already"),
        ({"behaviors.Probe.rewards.curiosity.strength": "0.1"}, "novelty is rewarded already"),
    ],
)
def test_what_a_run_has_already_is_not_proposed(options: dict[str, str], words: str) -> None:
    never = FACTS | {"decisions": 20_000, "rewards": FACTS["rewards"] | {"nonzero": 0}}
    cures = [f.cure for f in diagnose(Evidence(run_of(options), {"Probe": never})) if f.kind == "no reward"]
    assert len(cures) == 1 and f"If it is far to find: {words}" in cures[0]


def test_a_frozen_behavior_has_no_findings_of_learning() -> None:
    still = {"Ball/kl": 1e-9, "Ball/clip_fraction": 0.0, "kl": 1e-9, "clip_fraction": 0.0}
    run = run_of(return_mean=0.0, **still, **{"Goal/frozen": 1.0})
    (said,) = [
        finding.text
        for finding in diagnose(Evidence(run, {"Ball": FACTS, "Goal": FACTS}))
        if finding.kind == "no steps"
    ]
    assert said == "Ball: updates change nothing"


def test_what_the_environment_sends() -> None:
    wide = FACTS["elements"] | {"greatest": [1.0, 101.0]}
    assert found({"elements": wide}) == [], "normalised"
    assert found({"elements": wide}, {"model.normalize_obs": "false"}) == ["huge"]
    assert found({"elements": wide}, {"behaviors.Probe.model.normalize_obs": "false"}) == ["huge"]
    assert found({"images": {"obs_1": {"least": 7.0, "greatest": 7.0}}}) == ["constant"]
    assert found({"sets": {"obs_1": {"least": 1.0, "greatest": 1.0}}}) == [], "entities that are all alike"
    assert found({"never_allowed": [2]}) == ["never allowed"]
    assert found({"slots": {"all": 32, "idle": 4}}) == ["idle agents"]
    assert found({"slots": {"all": 32, "idle": 3}}) == [], "some of a team may be dead for long"
    assert found({"decisions": 4999, "slots": {"all": 32, "idle": 32}}) == [], "too early to say"
    assert found({"rewards": FACTS["rewards"] | {"nonzero": 0}}) == ["no reward"]

    two = {"Probe": FACTS, "Other": FACTS | {"decisions": 0}}
    assert kinds(Evidence(run_of(), two)) == ["never asked"]
    two["Other"]["opposed"] = True
    assert kinds(Evidence(run_of(), two)) == [], "its side learns later, opponents play its teams"

    ends = {"elements": FACTS["elements"] | {"clipped": [1], "clipped_share": 0.5}}
    assert found(ends) == ["clipped"]
    assert found(ends | {"vectors": [["RayPerceptionSensor", 2]]}) == [], "a ray that meets nothing"


@pytest.mark.parametrize("others", [[], ["obs_1"], ["obs_2"], ["obs_1", "obs_2"]])
def test_whoever_has_a_camera_or_entities_does_not_see_the_same(others: list[str]) -> None:
    sensors = {"obs_1": torch.ones(3, 1, 2, 3, 4, 4), "obs_2": torch.zeros(3, 1, 2, 5, 2)}
    time = torch.arange(3.0).reshape(3, 1, 1, 1).expand(3, 1, 2, 1)
    seen = {keys.OBS: time, keys.ACTING: torch.ones(3, 1, 2, 1, dtype=torch.bool)}
    survey = PolicySurvey(BehaviorSpec([vector_spec(1)], ActionSpec.create_discrete((2,))))
    survey.look(TensorDict(seen | {name: sensors[name] for name in others}, [3, 1, 2]))

    facts = survey.facts
    assert facts["same_for_all"] == (None if others else True)
    assert list(facts["images"]) == [name for name in others if name == "obs_1"]
    assert list(facts["sets"]) == [name for name in others if name == "obs_2"]
    wanted = {
        "obs_1": "Probe: the images of obs_1 never change",
        "obs_2": "Probe: obs_2 never holds an entity",
    }
    evidence = Evidence(run_of(), {"Probe": FACTS | {kind: facts[kind] for kind in ("images", "sets")}})
    assert [finding.text for finding in diagnose(evidence)] == [wanted[name] for name in others]


def test_a_spec_of_numpy_numbers_is_surveyed(tmp_path: Path) -> None:
    sensor = vector_spec(3)._replace(shape=(np.prod([3, 1]),))
    spec = BehaviorSpec([sensor], ActionSpec(np.int32(0), (np.int64(2),)))
    facts = Survey({"Probe": spec}, {"Probe": ["Probe"]}).as_dict()
    assert json.loads(json.dumps(facts))["Probe"]["branches"] == [2]
    assert json.loads(json.dumps(describe_spec(spec, 1)))["sensors"] == [[3]]


def test_what_slows_a_run_down() -> None:
    slow = {"collect_s": 9.0, "update_s": 0.5}  # 105 decisions/s
    assert found(**slow) == [], "nothing of the user's is slow"
    assert found(options={"env.backend": "player"}, **slow) == ["slow environment"]
    assert found(collect_s=0.5, update_s=9.0) == ["slow learning"]
    assert found(restarts=3.0, dropped_steps=2001.0) == ["crashes"]
    assert found(restarts=3.0, dropped_steps=1999.0) == []


# --- the command, and mistakes


def test_the_command_says_what_where_and_the_cure(tmp_path: Path, capsys: Any) -> None:
    train(tmp_path / "a", "constant", "max_steps=8192")
    train(tmp_path / "b", "one_action", "max_steps=8192")
    capsys.readouterr()
    assert doctor_main([f"run={tmp_path}"]) == 1
    out = capsys.readouterr().out
    assert "sensor gauge never changes: its 3 elements were the same in 8,192 decisions" in out
    assert "CollectObservations" in out and "masks leave one action" in out

    assert report_main([str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text()
    assert "Diagnosis" in page and "sensor gauge never changes" in page and "CollectObservations" in page


def test_a_run_without_a_survey_is_judged_by_its_metrics(tmp_path: Path, capsys: Any) -> None:
    train(tmp_path, "constant", "max_steps=5120")
    for text in ("{", "[]", '{"Probe": {}}', '{"Probe": null}'):
        (tmp_path / "survey.json").write_text(text)
        assert doctor_main([f"run={tmp_path}"]) == 0
        assert "no survey.json" in capsys.readouterr().out
    (tmp_path / "survey.json").unlink()
    assert kinds(Evidence.of(read_run(tmp_path))) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run="], "run= names no folder"),
        (["run=nowhere"], "run=nowhere does not exist"),
        (["run=empty"], "run=empty is no run folder"),
        (["run=empty", "--editor"], "--editor does not go with run="),
        (["empty"], "did you mean --file-name empty?"),
    ],
)
def test_mistakes_have_one_line(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    assert doctor_main(words) == 2
    errors = capsys.readouterr().err
    assert said in errors and "Traceback" not in errors and len(errors.splitlines()) == 1


def test_a_survey_that_cannot_be_written_costs_itself_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(survey: Survey, folder: Path) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(Survey, "write", full)
    assert train(tmp_path, "constant", "max_steps=4096") == []
    assert read_survey(tmp_path) == {}


def test_returns_are_kept_evenly(tmp_path: Path) -> None:
    survey = PolicySurvey(BehaviorSpec([vector_spec(1)], ActionSpec.create_discrete((2,))))
    survey.count_episodes([Episode(0, float(value), 0.0, 5, False) for value in range(1, 5001)])
    kept = survey.facts["returns"]
    assert 5000 / 8 == len(kept) <= RETURNS
    assert kept == [8.0 * i for i in range(1, 626)]
