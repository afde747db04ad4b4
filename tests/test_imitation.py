"""Demonstrations as teachers: cloning alone and beside PPO, with and without a memory, and GAIL."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from mlagents_envs.base_env import ActionSpec, BehaviorSpec

from mappo_unity import load_policy
from mappo_unity.cli import eval_main, play_main, train_main
from mappo_unity.config.schema import BCConfig, GAILConfig, MemoryKind, ModelConfig, Optimizer, PPOConfig
from mappo_unity.learning.imitation.cloning import Cloning, _cut
from mappo_unity.learning.imitation.expert import Expert, make_expert
from mappo_unity.learning.networks.actor_critic import UnityActor, make_actor
from mappo_unity.learning.networks.distributions import ActionDistribution, ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.rewards.gail import BETA_STEP, INFORMATION, Discriminator
from mappo_unity.learning.rewards.streams import IntrinsicStream
from mappo_unity.protocol.demos import reader
from mappo_unity.protocol.demos.demonstration import Demonstration
from mappo_unity.protocol.demos.replay_env import ReplayEnv
from mappo_unity.runs import checkpoint
from mappo_unity.scenes import make_scene


def vector_sensor(size: int):
    from fakes import vector_spec

    return vector_spec(size)


def demonstration(
    actions: ActionSpec, lengths: tuple[int, ...] = (30, 20, 10), size: int = 3, recalls: bool = False
) -> Demonstration:
    """Return episodes whose action follows from what is seen: its sign, or the sign seen at first."""
    rng = np.random.default_rng(0)
    frames, rows, sign = [], [], []
    for length in lengths:
        seen = rng.choice([-1.0, 1.0], (length + 1, size))
        if recalls:
            seen[1:] = 0  # what is to be done is shown at first only
        rows += [len(frames) + i for i in range(length)]
        sign += [np.sign(seen[0 if recalls else i, 0]) for i in range(length)]
        frames += list(seen)

    done = np.zeros(len(rows), bool)
    done[np.cumsum(lengths) - 1] = True
    right = np.array(sign) > 0
    return Demonstration(
        source="test.demo",
        behavior="Fake",
        spec=BehaviorSpec([vector_sensor(size)], actions),
        frames=[np.array(frames, np.float32)],
        rows=np.array(rows),
        continuous=np.repeat(np.where(right, 0.5, -0.5)[:, None], actions.continuous_size, 1).astype(
            np.float32
        ),
        discrete=np.repeat(right[:, None], actions.discrete_size, 1).astype(np.int32),
        has_action=np.ones(len(rows), bool),
        mask=None,
        reward=np.arange(len(rows), dtype=np.float32),
        group_reward=np.zeros(len(rows), np.float32),
        done=done,
        interrupted=np.zeros(len(rows), bool),
        first=np.roll(done, 1),
    )


def actor_of(spec: ActionSpec, memory: MemoryKind = MemoryKind.none) -> UnityActor:
    torch.manual_seed(0)
    cfg = ModelConfig(hidden=[32], normalize_obs=False, memory=memory, memory_size=16)
    return make_actor(ObsLayout(3), ActionLayout.from_spec(spec), 1, cfg)


def clone(
    actor: UnityActor, demo: Demonstration, times: int = 60, **options: object
) -> tuple[Cloning, list[float]]:
    ppo = PPOConfig(lr=1e-2, minibatch_size=32, epochs=2, sequence_length=16)
    cloning = Cloning(actor, make_expert(demo, ["observation"], "cpu"), BCConfig(demos=["x"], **options), ppo)
    return cloning, [cloning.learn(60, 1e-2, 0.0)["bc_loss"] for _ in range(times)]


SPECS = [ActionSpec(2, ()), ActionSpec(0, (2, 2)), ActionSpec(1, (2,))]


@pytest.mark.parametrize("spec", SPECS, ids=["continuous", "discrete", "mixed"])
def test_a_clone_does_what_was_shown(spec: ActionSpec) -> None:
    actor, demo = actor_of(spec), demonstration(spec)
    clone(actor, demo)
    expert = make_expert(demo, ["observation"], "cpu")
    with torch.no_grad():
        mode = ActionDistribution(actor[0].module(*expert.steps.obs), actor.layout).mode
    # continuous actions of the network are 3 times those of the environment
    size = spec.continuous_size
    assert torch.allclose(mode[:, :size], expert.steps.action[:, :size], atol=0.15)
    assert expert.steps.action[:, :size].abs().unique().tolist() == [1.5] * bool(size)
    assert torch.equal(mode[:, size:], expert.steps.action[:, size:])


@pytest.mark.parametrize("memory", [MemoryKind.lstm, MemoryKind.gru, MemoryKind.traces])
def test_a_clone_with_a_memory_remembers_what_was_shown_at_first(memory: MemoryKind) -> None:
    spec = ActionSpec(0, (2,))
    demo = demonstration(spec, (20,) * 12, recalls=True)
    _, losses = clone(actor_of(spec, memory), demo, 80)
    assert losses[-1] < 0.1
    # without one it cannot be told: log 2 a decision, but for the first of twenty
    _, losses = clone(actor_of(spec), demo, 80)
    assert losses[-1] > 0.5


@pytest.mark.parametrize("memory", [MemoryKind.lstm, MemoryKind.traces])
def test_states_before_pieces_are_those_of_the_whole_episode(memory: MemoryKind) -> None:
    spec = ActionSpec(0, (2,))
    actor = actor_of(spec, memory)
    cloning, _ = clone(actor, demonstration(spec, (9, 4)), 1)
    states, table = cloning._states(), cloning._expert.steps.table[0]
    state = torch.zeros(1, actor.memory_size)
    for number, row in enumerate(range(9)):
        assert torch.allclose(states[number], state[0], atol=1e-6)
        state = actor[0].module(table[row : row + 1], state)[1].detach()
    assert not states[9].any()  # the second episode begins anew


@pytest.mark.parametrize("kind", Optimizer)
def test_weight_decay_holds_in_cloning_too(kind: Optimizer) -> None:
    spec = ActionSpec(0, (2,))
    demo = demonstration(spec)
    sizes = []
    for decay in (0.0, 5.0):
        actor = actor_of(spec)
        ppo = PPOConfig(lr=1e-2, minibatch_size=32, epochs=2, optimizer=kind, weight_decay=decay)
        cloning = Cloning(actor, make_expert(demo, ["observation"], "cpu"), BCConfig(demos=["x"]), ppo)
        for _ in range(20):
            cloning.learn(60, 1e-2, 0.0)
        sizes.append(sum(float(weights.detach().square().sum()) for weights in actor.parameters()))
    assert sizes[1] < 0.5 * sizes[0]


def test_episodes_are_cut_into_pieces() -> None:
    first = torch.tensor([True, False, False, False, False, True, False])
    assert _cut(first, 2).tolist() == [[0, 2], [2, 2], [4, 1], [5, 2]]
    assert _cut(first, 100).tolist() == [[0, 5], [5, 2]]


def test_the_strength_falls_to_nothing() -> None:
    spec = ActionSpec(0, (2,))
    actor = actor_of(spec)
    expert = make_expert(demonstration(spec), ["observation"], "cpu")
    cfg = BCConfig(demos=["x"], strength=0.5, steps=200)
    cloning = Cloning(actor, expert, cfg, PPOConfig(), max_steps=1000)
    told = [cloning.learn(60, 1e-3, progress).get("bc_strength") for progress in (0.0, 0.1, 0.2, 0.9)]
    assert told == pytest.approx([0.5, 0.25, 0.0, 0.0])
    before = [p.clone() for p in actor.parameters()]
    cloning.learn(60, 1e-3, 0.5)
    assert all(torch.equal(a, b) for a, b in zip(before, actor.parameters()))


def test_decisions_whose_action_is_not_known_teach_nothing() -> None:
    demo = demonstration(ActionSpec(0, (2,)))
    demo.has_action[[0, 29, 30]] = False
    expert = make_expert(demo, ["observation"], "cpu")
    assert len(expert) == 57
    assert expert.first.nonzero().flatten().tolist() == [0, 28, 47]


def test_what_an_expert_did_is_allowed_though_its_mask_forbids_it() -> None:
    demo = demonstration(ActionSpec(0, (2, 2)))
    mask = np.zeros((len(demo.discrete), 4), bool)
    mask[:, [0, 2]] = True
    demo = replace(demo, mask=mask)
    demo.discrete[5] = [1, 0]
    expert = make_expert(demo, ["observation"], "cpu")
    assert expert.mask is not None
    assert expert.mask[5].tolist() == [True, True, True, False]
    taken = expert.mask.gather(1, expert.steps.action + torch.tensor([0, 2]))
    assert taken.all()


# --- played back


def test_a_demonstration_is_played_back_episode_after_episode() -> None:
    demo = demonstration(ActionSpec(0, (2,)), (3, 2, 1))
    env = ReplayEnv({"Fake": demo})
    env.reset()
    seen: list[list[float]] = []
    for _ in range(7):
        decisions, terminal = env.get_steps("Fake")
        seen.append([*decisions.reward.tolist(), *terminal.reward.tolist()])
        assert not terminal.interrupted.any()
        env.step()
    # three agents, an episode each: of 3 decisions (rewards 0 1 2), of 2 (3 4) and of 1 (5)
    assert seen[0] == [0, 0, 0]
    assert seen[1] == [0, 3, 0, 5]
    assert seen[2] == [1, 0, 0, 4, 5]
    assert seen[3] == [0, 3, 0, 2, 5]

    again = ReplayEnv({"Fake": demo})
    again.set_state(env.get_state())
    for step in range(3):
        # the ends and the rewards of the result that was saved have been told
        parts = slice(1) if step == 0 else slice(2)
        results = zip(env.get_steps("Fake")[parts], again.get_steps("Fake")[parts], strict=True)
        for one, two in results:
            np.testing.assert_array_equal(one.agent_id, two.agent_id)
            np.testing.assert_array_equal(one.obs[0], two.obs[0])
            if step:
                np.testing.assert_array_equal(one.reward, two.reward)
        env.step(), again.step()


# --- GAIL


@pytest.mark.parametrize("options", [{}, {"use_actions": True}, {"use_vail": True}], ids=str)
@pytest.mark.parametrize("spec", SPECS, ids=["continuous", "discrete", "mixed"])
def test_a_discriminator_tells_experts_apart(spec: ActionSpec, options: dict[str, bool]) -> None:
    expert = make_expert(demonstration(spec), ["observation"], "cpu")
    cfg = GAILConfig(strength=1.0, demos=["x"], hidden=[32], lr=3e-3, **options)
    torch.manual_seed(0)
    layout = ActionLayout.from_spec(spec)
    stream = IntrinsicStream("gail", Discriminator(ObsLayout(3), layout, cfg, expert), cfg)

    ours = Expert(expert.steps, expert.first, None).steps
    table = [torch.full_like(ours.table[0], 3.0)]
    ours = type(ours)(table, ours.at, ours.following, ours.action, ours.ended)
    for _ in range(60):
        stream.learn(ours, PPOConfig(epochs=1, minibatch_size=64))
    assert stream.model.rewards(expert.steps).mean() > 1.5 * stream.model.rewards(ours).mean()


def test_the_price_of_information_rises_while_there_is_too_much_of_it() -> None:
    spec = ActionSpec(0, (2,))
    expert = make_expert(demonstration(spec), ["observation"], "cpu")
    cfg = GAILConfig(strength=1.0, demos=["x"], hidden=[32], use_vail=True)
    torch.manual_seed(0)
    model = Discriminator(ObsLayout(3), ActionLayout.from_spec(spec), cfg, expert)

    prices = []
    for mean in (0.0, 10.0):  # KL to a standard normal: 0, and 50 nats for each of its numbers, twice
        torch.nn.init.zeros_(model.mean.weight)
        torch.nn.init.constant_(model.mean.bias, mean)
        model.beta.fill_(0.5)
        model.loss(expert.steps)
        prices.append(float(model.beta))
    surplus = np.array([0.0, 2 * 50.0 * len(model.mean.bias)]) - INFORMATION  # the expert's and the policy's
    assert prices == pytest.approx(0.5 + BETA_STEP * surplus)


def test_the_reward_of_gail_by_hand() -> None:
    spec = ActionSpec(0, (2,))
    expert = make_expert(demonstration(spec), ["observation"], "cpu")
    cfg = GAILConfig(strength=1.0, demos=["x"], hidden=[4])
    model = Discriminator(ObsLayout(3), ActionLayout(0, (2,)), cfg, expert)
    with torch.no_grad():
        model.head.weight.zero_()
        model.head.bias.fill_(1.0)
    # D = sigmoid(1) everywhere: -log(1 - D) = log(1 + e)
    assert model.rewards(expert.steps)[0].item() == pytest.approx(np.log(1 + np.e), rel=1e-6)
    # -log D - log(1 - D), and no gradient at all: 10 * (0 - 1)**2
    loss = np.log(1 + np.exp(-1)) + np.log(1 + np.e) + 10
    assert model.loss(expert.steps).item() == pytest.approx(loss, rel=1e-5)


# --- runs


@pytest.fixture(scope="module")
def demo_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of random play in Basic, made as a user makes one."""
    path = tmp_path_factory.mktemp("demos") / "basic.demo"
    assert play_main(["env=Basic", f"record={path}", "seconds=20"]) == 0
    return path


TINY = ["env=Basic", "model.hidden=[16]", "log.progress=false", "log.loggers=[]"]
TINY += ["collect.batch_size=200", "ppo.lr_schedule=constant", "ppo.entropy_schedule=constant"]


@pytest.mark.parametrize(
    "teachers",
    [["bc.only=true"], ["bc.strength=0.5", "bc.steps=700"], ["gail"], ["gail", "model.memory=lstm"]],
    ids=["only", "beside", "gail", "gail and memory"],
)
def test_runs_with_demonstrations_resume_to_the_bit(
    teachers: list[str], demo_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    demos = f"demos=[{demo_file}]"
    if teachers[0] == "gail":
        line = [*TINY, *teachers[1:], "rewards.gail.strength=0.5", f"rewards.gail.{demos}"]
    else:
        line = [*TINY, *teachers, f"bc.{demos}"]

    assert train_main([*line, "max_steps=800", "hydra.run.dir=whole"]) == 0
    assert train_main([*line, "max_steps=400", "hydra.run.dir=parts"]) == 0
    assert train_main(["resume=parts", "max_steps=800"]) == 0
    newest = [sorted(Path(name, "checkpoints").glob("step_*.pt"))[-1] for name in ("whole", "parts")]
    one, two = (checkpoint.load(path)["learners"]["Basic"] for path in newest)
    assert all(torch.equal(one["actor"][name], two["actor"][name]) for name in one["actor"])

    assert eval_main(["run=whole", "episodes=1"]) == 0


def test_both_sides_are_cloned_and_play_matches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert play_main(["env=SoccerTwos", "record=two.demo", "seconds=3"]) == 0
    line = ["env=SoccerTwos", *TINY[1:], "bc.only=true", "bc.demos=[two.demo]", "env.num_areas=2"]
    line += ["export_onnx=false", "matches.count=2", "hydra.run.dir=run"]  # the preset asks for matches

    # the recording is of one file, and read once for both sides and for the cloning
    read: list[Path] = []
    monkeypatch.setattr(reader, "_read", lambda path, plain=reader._read: read.append(path) or plain(path))
    assert train_main([*line, "max_steps=200"]) == 0
    assert read == [Path("two.demo")]
    assert "of 2 matches against a random side" in capsys.readouterr().out

    # members of a team, though each was cloned by itself
    state = checkpoint.load(Path("run/checkpoints/best.pt"))
    assert state["layout"]["SoccerTwos"]["team_size"] == 1 and len(state["env"]["behaviors"]) == 2
    policy = load_policy("run")
    scene = make_scene("SoccerTwos", seed=0, num_areas=1)
    scene.reset()
    for name, spec in scene.behavior_specs.items():
        steps = scene.get_steps(name)[0]
        assert len(steps) == 2 and policy.act(name, steps, spec).discrete.shape == (2, 3)


@pytest.mark.parametrize(
    "lines, message",
    [
        (["bc.only=true"], "bc.only=true needs demonstrations: bc.demos=[expert.demo]"),
        (["bc.strength=0"], "bc.strength must be > 0"),
        (["bc.steps=-1"], "bc.steps must be >= 0"),
        (["bc.only=true", "bc.steps=5", "bc.demos=[x.demo]"], "does not go with bc.only=true"),
        (["bc.demos=[missing.demo]"], "missing.demo does not exist"),
        (["rewards.gail.strength=1"], "needs demonstrations: rewards.gail.demos=[expert.demo]"),
        (["rewards.gail.strength=1", "rewards.gail.demos=[missing.demo]"], "missing.demo does not exist"),
        (["env=3DBall", "bc.demos=[DEMO]"], "does not fit the behavior '3DBall'"),
        (["env=3DBall", "bc.only=true", "bc.demos=[DEMO]"], "does not fit the behavior '3DBall'"),
    ],
)
def test_mistakes_are_explained(
    lines: list[str],
    message: str,
    demo_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [line.replace("DEMO", str(demo_file)) for line in lines]
    assert train_main([*([] if lines[0].startswith("env=") else ["env=Basic"]), *lines]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not any(Path("outputs").glob("*/*"))


# --- recordings from Unity


def test_unitys_recording_of_pyramids_is_cloned(shared: Path, tmp_path: Path) -> None:
    demo = shared / "mlagents" / "demos" / "ExpertPyramid.demo"
    line = ["env=Pyramids", "model.hidden=[64]", "log.progress=false", "log.loggers=[]", "bc.only=true"]
    line += [f"bc.demos=[{demo}]", "collect.batch_size=1000", "ppo.lr=2e-3", "ppo.minibatch_size=256"]
    assert train_main([*line, "max_steps=10000", f"hydra.run.dir={tmp_path}/run"]) == 0
    head, *rows = (tmp_path / "run" / "metrics.csv").read_text().splitlines()
    column = head.split(",").index("bc_loss")
    losses = [float(row.split(",")[column]) for row in rows]
    assert losses[-1] < 0.7 * losses[0]
