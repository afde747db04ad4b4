"""Reward streams: values and discounts of their own, intrinsic rewards of decisions, what they find."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from masked import whole
from tensordict import TensorDict

from mappo_unity import keys
from mappo_unity.cli import train_main
from mappo_unity.config.schema import (
    Backend,
    CollectConfig,
    Config,
    CuriosityConfig,
    EnvConfig,
    ExtrinsicConfig,
    GAILConfig,
    ImageKind,
    LogConfig,
    ModelConfig,
    PPOConfig,
    RewardsConfig,
    RNDConfig,
    Schedule,
)
from mappo_unity.learning.advantage import estimate, estimate_streams, make_view
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.rewards.curiosity import Curiosity
from mappo_unity.learning.rewards.rnd import RandomNetwork
from mappo_unity.learning.rewards.streams import IntrinsicStream, RewardStreams, make_models
from mappo_unity.learning.transitions import Transitions, find_transitions
from mappo_unity.learning.value_norm import ValueNorm, by_stream
from mappo_unity.runs import checkpoint
from mappo_unity.training.setup import set_up


def flags(*rows: list[int]) -> torch.Tensor:
    """Return bool ``[T, A, 1]`` from a row of 0 and 1 for each round."""
    return torch.tensor(rows, dtype=torch.bool).unsqueeze(-1)


# --- the maths


def test_each_stream_has_its_own_discount_and_value() -> None:
    torch.manual_seed(0)
    shape = (6, 3, 1)
    reward, value, end = torch.randn(3, *shape[:-1], 2).unbind(0)
    final, cut = torch.randn(3, 2), torch.rand(shape) < 0.2
    view = make_view(torch.ones(shape, dtype=torch.bool), torch.ones(3, 1, dtype=torch.bool), cut)
    both = estimate_streams(view, reward, value, end, final, cut, gammas=[0.9, 0.5], gae_lambda=0.95)

    for number, gamma in enumerate((0.9, 0.5)):
        columns = [x[..., number : number + 1] for x in (reward, value, end, final)]
        alone = estimate(view, *columns, cut, gamma=gamma, gae_lambda=0.95)
        assert torch.equal(both.advantage[..., number : number + 1], alone.advantage)
        assert torch.equal(both.target[..., number : number + 1], alone.target)


def test_the_statistics_of_streams_do_not_mix() -> None:
    norm = ValueNorm(0.9, streams=2)
    returns = torch.randn(1000, 2) * torch.tensor([1.0, 100.0]) + torch.tensor([0.0, 500.0])
    norm.update(returns)
    assert torch.allclose(norm.normalize(returns).mean(0), torch.zeros(2), atol=1e-4)
    assert torch.allclose(norm.normalize(returns).std(0, unbiased=False), torch.ones(2), atol=1e-4)
    assert torch.allclose(norm.denormalize(norm.normalize(returns)), returns, rtol=1e-4, atol=1e-4)


def test_statistics_from_before_streams_are_still_read() -> None:
    norm = ValueNorm(0.9)
    old = {"mean": torch.tensor(3.0), "mean_sq": torch.tensor(10.0), "debias": torch.tensor(1.0)}
    norm.load_state_dict(by_stream({name: value.double() for name, value in old.items()}))
    assert [moment.tolist() for moment in norm.statistics()] == [[3.0], [1.0]]


# --- decisions


def test_what_follows_a_decision_is_the_agents_next_one_or_its_end() -> None:
    # agent 0 is asked in rounds 0 and 2 and ends in 3; agent 1 in every round, and goes on
    asked = flags([1, 1], [0, 1], [1, 1], [0, 1])
    seen = torch.arange(8.0).view(4, 2, 1)
    none = torch.zeros_like(asked)
    ended = none.clone()
    ended[3, 0] = True
    rounds = TensorDict({"observation": seen, keys.ACTING: asked, keys.ACTION: seen + 100}, [4, 2])
    after = torch.arange(50.0, 58.0).view(4, 2, 1)
    rounds["next"] = TensorDict({"observation": after}, [4, 2])
    following = whole(rounds)[1]
    view = make_view(asked, flags([0, 1])[0], ended)

    found = find_transitions(rounds, following, view, ["observation"])
    steps = zip(*(x.flatten().tolist() for x in (found.obs[0], found.next_obs[0], found.action)))
    # observation decided on, observation that followed, action
    assert set(steps) == {(0, 4, 100), (1, 3, 101), (3, 5, 103), (4, 56, 104), (5, 7, 105), (7, 57, 107)}
    assert found.obs[0][found.ended].flatten().tolist() == [4]


def decisions(layout: ActionLayout, size: int = 5, count: int = 64) -> Transitions:
    """Return random decisions, one after the other."""
    torch.manual_seed(1)
    action = torch.randn(count, layout.continuous)
    branches = [torch.randint(n, (count, 1)).float() for n in layout.branches]
    at = torch.arange(count)
    ended = torch.zeros(count, dtype=torch.bool)
    return Transitions([torch.randn(count + 1, size)], at, at + 1, torch.cat([action, *branches], -1), ended)


# --- curiosity and RND


def test_curiosity_by_hand() -> None:
    model = Curiosity(ObsLayout(2), ActionLayout(0, (2,)), CuriosityConfig(hidden=[2], strength=1.0))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
        # features are silu of the observation; the forward model foresees (0.5, 0), the inverse knows nothing
        model.body[0][0].weight.copy_(torch.eye(2))
        model.foresight[-1].bias.copy_(torch.tensor([0.5, 0.0]))

    one = Transitions(
        [torch.tensor([[1.0, 0.0], [0.0, 2.0]])],
        torch.tensor([0]),
        torch.tensor([1]),
        torch.tensor([[1]]),
        torch.tensor([False]),
    )
    # the next features are (0, silu(2) = 2 * 0.880797); the error is half of 0.5**2 + 1.761594**2
    error = 0.5 * (0.25 + 1.761594**2)
    assert model.rewards(one).item() == pytest.approx(error, rel=1e-5)
    # of two actions it can say no more than log 2
    assert model.loss(one).item() == pytest.approx(10 * (0.2 * error + 0.8 * np.log(2)), rel=1e-5)


def test_rnd_by_hand() -> None:
    model = RandomNetwork(ObsLayout(1), ActionLayout(0, (2,)), RNDConfig(hidden=[1], strength=1.0))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
        # the random network says 3 silu(x) + 1, the predictor always 0.5
        model.target.net[0].weight.fill_(1.0)
        model.target.net[-1].weight.fill_(3.0)
        model.target.net[-1].bias.fill_(1.0)
        model.predictor.net[-1].bias.fill_(0.5)

    seen = Transitions(
        [torch.tensor([[5.0], [2.0], [0.0]])],
        torch.tensor([0, 1]),
        torch.tensor([1, 2]),
        torch.tensor([[1], [0]]),
        torch.tensor([False, False]),
    )
    # what was seen next counts: 2, then 0; silu(2) = 2 * 0.880797
    errors = [(3 * 1.761594 + 1 - 0.5) ** 2, (1 - 0.5) ** 2]
    assert model.rewards(seen).tolist() == pytest.approx(errors, rel=1e-5)
    assert model.loss(seen).item() == pytest.approx(sum(errors) / 2, rel=1e-5)


@pytest.mark.parametrize(
    ("encoder", "kernel"),
    [(ImageKind.auto, 8), (ImageKind.grid, 5), (ImageKind.simple, 8), (ImageKind.match3, 8)],
)
def test_models_see_images_through_an_encoder_of_ours(encoder: ImageKind, kernel: int) -> None:
    """The policy's, where that is one of ours; else the default one, as checkpoints have it."""
    rewards = RewardsConfig(
        curiosity=CuriosityConfig(strength=0.1),
        rnd=RNDConfig(strength=0.1),
        gail=GAILConfig(strength=0.1, demos=["some.demo"]),
    )
    obs = ObsLayout.from_shapes([[3], [6, 20, 20]])
    models = make_models(obs, ActionLayout(0, (2,)), rewards, images=encoder)
    assert set(models) == {"curiosity", "rnd", "gail"}
    for model in models.values():
        first = next(layer for layer in model.modules() if isinstance(layer, torch.nn.Conv2d))
        assert first.kernel_size == (kernel, kernel)


@pytest.mark.parametrize("kind", [Curiosity, RandomNetwork])
@pytest.mark.parametrize("layout", [ActionLayout(2, ()), ActionLayout(0, (3, 2)), ActionLayout(1, (4,))])
def test_what_was_often_seen_earns_little(kind: type, layout: ActionLayout) -> None:
    torch.manual_seed(0)
    cfg = CuriosityConfig(hidden=[32], lr=1e-2) if kind is Curiosity else RNDConfig(hidden=[32], lr=1e-2)
    stream = IntrinsicStream("new", kind(ObsLayout(5), layout, cfg), cfg)
    seen = decisions(layout)
    before = stream.model.rewards(seen).mean()
    target = [p.clone() for p in stream.model.target.parameters()] if kind is RandomNetwork else []
    for _ in range(60):
        stream.learn(seen, PPOConfig(epochs=2, minibatch_size=32))
    assert stream.model.rewards(seen).mean() < 0.3 * before
    if kind is RandomNetwork:  # the random network itself stays as it was
        assert all(torch.equal(a, b) for a, b in zip(target, stream.model.target.parameters()))


def test_normalised_rewards_have_returns_of_deviation_one() -> None:
    layout, cfg = ActionLayout(2, ()), RNDConfig(hidden=[16], strength=0.5, gamma=0.0)
    stream = IntrinsicStream("rnd", RandomNetwork(ObsLayout(5), layout, cfg), cfg)
    seen = decisions(layout)
    valued = np.ones((64, 1), bool)
    view = DecisionView.of(valued, valued[0], np.zeros_like(valued))
    reward, metrics = stream.rewards(seen, view)
    # without a discount a return is the reward; the strength comes on top
    assert float(reward.std(unbiased=False)) == pytest.approx(0.5, rel=1e-3)
    assert metrics["rnd_reward"] == pytest.approx(2 * float(reward.mean()), rel=1e-5)

    raw = RNDConfig(hidden=[16], strength=0.5, normalize=False)
    plain = IntrinsicStream("rnd", stream.model, raw)
    assert torch.allclose(plain.rewards(seen, view)[0], 0.5 * stream.model.rewards(seen))


def test_the_strength_of_a_stream_falls_to_nothing() -> None:
    layout, cfg = ActionLayout(2, ()), RNDConfig(hidden=[16], strength=0.5, steps=200, normalize=False)
    stream = IntrinsicStream("rnd", RandomNetwork(ObsLayout(5), layout, cfg), cfg, max_steps=1000)
    seen = decisions(layout)
    valued = np.ones((64, 1), bool)
    view = DecisionView.of(valued, valued[0], np.zeros_like(valued))

    whole_reward = stream.rewards(seen, view)[0]
    told = [stream.begin(progress)["rnd_strength"] for progress in (0.0, 0.2, 0.9, 0.1)]
    assert told == pytest.approx([0.5, 0.0, 0.0, 0.25])
    assert torch.allclose(stream.rewards(seen, view)[0], 0.5 * whole_reward)

    # in the end nothing is earned, and the model learns no more
    stream.begin(0.2)
    before = [p.clone() for p in stream.model.parameters()]
    reward, metrics = stream.rewards(seen, view)
    assert not reward.any() and metrics == {} and stream.learn(seen, PPOConfig()) == {}
    assert all(torch.equal(a, b) for a, b in zip(before, stream.model.parameters()))

    # without steps it stays, and nothing is said
    stays = IntrinsicStream("rnd", stream.model, RNDConfig(strength=0.5), max_steps=1000)
    assert stays.begin(1.0) == {} and stays.left == 1.0


def test_without_a_decision_whose_outcome_is_known_nothing_is_earned_and_learnt() -> None:
    layout, cfg = ActionLayout(2, ()), RNDConfig(hidden=[16], strength=0.5)
    stream = IntrinsicStream("rnd", RandomNetwork(ObsLayout(5), layout, cfg), cfg)
    nobody = torch.zeros(3, 2, 1, dtype=torch.bool)
    entries: dict[str, Any] = {keys.ACTING: nobody, "observation": torch.zeros(3, 2, 5)}
    entries |= {keys.ACTION: torch.zeros(3, 2, 2)}
    entries |= {key: torch.zeros(3, 2, 1) for key in (keys.REWARD, keys.GROUP_REWARD)}
    streams = RewardStreams(PPOConfig(), RewardsConfig(rnd=cfg), [stream], ["observation"])
    rounds = TensorDict(entries, [3, 2])
    rounds["next"] = rounds.clone()
    rewards, metrics = streams.rewards(*whole(rounds), make_view(nobody, nobody[0], nobody))
    assert rewards.shape == (3, 2, 2) and not rewards.any()
    assert metrics == {} and streams.learn() == {}


def test_the_environments_rewards_have_a_strength_and_a_discount() -> None:
    cfg = RewardsConfig(extrinsic=ExtrinsicConfig(strength=2.0, gamma=0.5))
    streams = RewardStreams(PPOConfig(reward_weight=3.0, group_reward_weight=0.5), cfg)
    assert streams.gammas == [0.5]

    # which no schedule of ppo.gamma moves
    moving = PPOConfig(gamma=0.9, gamma_schedule=Schedule.linear, gamma_final=1.0)
    still = RewardStreams(moving, cfg)
    assert still.begin(1.0) == {} and still.gammas == [0.5]
    moved = RewardStreams(moving)
    assert moved.begin(0.5) == {"gamma": pytest.approx(0.95)} and moved.gammas == [pytest.approx(0.95)]

    ones = torch.ones(1, 1, 1)
    rounds = TensorDict({keys.REWARD: ones, keys.GROUP_REWARD: ones}, [1, 1])
    view = make_view(ones.bool(), ones[0].bool(), ones.bool())
    assert float(streams.rewards(rounds, rounds, view)[0]) == 2 * 3.0 + 2 * 0.5


# --- learning


def learn(rewards: RewardsConfig, folder: Path, iterations: int) -> float:
    """Train on the chain; return all rewards that were found."""
    cfg = Config(
        env=EnvConfig(
            name="custom", backend=Backend.custom, factory="probes:make", params={"probe": "Chain"}
        ),
        model=ModelConfig(hidden=[32], normalize_obs=False),
        ppo=PPOConfig(
            lr=3e-3, lr_schedule=Schedule.constant, epochs=4, minibatch_size=128, entropy_coef=0.01
        ),
        rewards=rewards,
        collect=CollectConfig(rounds=32),
        log=LogConfig(loggers=[], progress=False),
        max_steps=10**9,
    )
    found = 0.0
    with set_up(cfg, folder) as setup, setup.collecting() as batches:
        for _ in range(iterations):
            batch, following = next(batches).of("Probe")
            setup.learners["Probe"].learn(batch, following, 0.0)
            found += float(batch["next", keys.REWARD].sum())
            if found:
                break
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    "rewards",
    [
        RewardsConfig(curiosity=CuriosityConfig(strength=0.5, hidden=[32])),
        RewardsConfig(rnd=RNDConfig(strength=0.5, hidden=[32], lr=1e-3)),
    ],
    ids=["curiosity", "rnd"],
)
def test_novelty_finds_a_reward_that_chance_does_not(rewards: RewardsConfig, tmp_path: Path) -> None:
    assert learn(rewards, tmp_path, 150) > 0


@pytest.mark.slow
def test_without_novelty_the_reward_is_not_found(tmp_path: Path) -> None:
    assert learn(RewardsConfig(), tmp_path, 60) == 0


SMALL = ["model.hidden=[16]", "log.progress=false", "log.loggers=[]", "ppo.minibatch_size=256"]
SMALL += ["ppo.epochs=1", "rewards.curiosity.strength=0.1", "rewards.rnd.strength=0.1"]
SMALL += ["rewards.curiosity.hidden=[16]", "rewards.rnd.hidden=[16]"]


@pytest.mark.parametrize(
    "line",
    [
        ["env=3DBall"],
        ["env=Hallway", "env.num_areas=4"],
        ["env=SoccerTwos", "model.critic=poca", "env.num_areas=2", "matches.interval=null"],
        ["env=GridFoodCollector", "env.num_areas=1"],
        ["env=DungeonEscape", "model.critic=poca", "model.memory=gru", "env.num_areas=4"],
    ],
    ids=lambda line: " ".join(line),
)
def test_streams_learn_with_every_kind_of_policy(line: list[str], tmp_path: Path) -> None:
    run = [*line, *SMALL, "collect.batch_size=100", "max_steps=200", f"hydra.run.dir={tmp_path}"]
    assert train_main(run) == 0
    head, *rows = (tmp_path / "metrics.csv").read_text().splitlines()
    last = dict(zip(head.split(","), rows[-1].split(",")))
    told = {name: float(value) for name, value in last.items() if "curiosity" in name or "rnd" in name}
    assert len(told) == 8 and all(map(np.isfinite, told.values()))
    assert all(value > 0 for name, value in told.items() if name.endswith("_reward"))


def test_a_run_with_streams_is_resumed_to_the_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    line = ["env=3DBall", *SMALL, "collect.batch_size=240", "ppo.lr_schedule=constant"]
    line += ["rewards.rnd.steps=720"]
    assert train_main([*line, "max_steps=960", "hydra.run.dir=whole"]) == 0
    assert train_main([*line, "max_steps=480", "hydra.run.dir=parts"]) == 0
    assert train_main(["resume=parts", "max_steps=960"]) == 0

    newest = (sorted(Path(name, "checkpoints").glob("step_*.pt"))[-1] for name in ("whole", "parts"))
    one, two = (checkpoint.load(path)["learners"]["3DBall"] for path in newest)
    for part in ("actor", "critic"):
        assert all(torch.equal(one[part][name], two[part][name]) for name in one[part])
    for name in ("curiosity", "rnd"):
        first, second = (state["rewards"][name] for state in (one, two))
        assert all(torch.equal(first["model"][key], second["model"][key]) for key in first["model"])
        assert torch.equal(first["returns"]["var"], second["returns"]["var"])

    # a stream's strength may change on the way, the streams themselves may not
    assert train_main(["resume=parts", "max_steps=1200", "rewards.rnd.strength=0.01"]) == 0
    capsys.readouterr()
    assert train_main(["resume=parts", "max_steps=1440", "rewards.rnd.strength=0"]) == 2
    assert "rewards.rnd" in capsys.readouterr().err


@pytest.mark.parametrize(
    "line, message",
    [
        ("rewards.curiosity.strength=-1", "rewards.curiosity.strength must be >= 0"),
        ("rewards.rnd.gamma=1.5", "rewards.rnd.gamma must be from 0 to 1"),
        ("rewards.rnd.lr=0", "rewards.rnd.lr must be > 0"),
        ("rewards.curiosity.hidden=[]", "rewards.curiosity.hidden=[] must be a list of at least one width"),
        ("rewards.extrinsic.gamma=2", "rewards.extrinsic.gamma must be from 0 to 1"),
        ("rewards.curiosity=0.02", "rewards.curiosity is a section"),
        ("rewards.curious.strength=1", "rewards.curiosity.strength"),
        ("behaviors.3DBall.rewards.rnd.size=1", "behaviors.3DBall.rewards.rnd.size is not an option"),
    ],
)
def test_mistakes_are_explained(
    line: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main(["env=3DBall", line, f"hydra.run.dir={tmp_path / 'run'}"]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
