"""Training on a device that is not the CPU: on a simulated one everywhere, on a GPU where there is one.

What is trained on the simulated device is interrupted and resumed on the way, and must end with the numbers
of an uninterrupted run on the CPU, to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import devices
import golden_runs
import numpy as np
import pytest
import torch
from fakes import Record
from test_drops import Fragile

from mappo_unity.cli import train_main
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.learning.carried import CarriedRounds
from mappo_unity.policies.matches import Score
from mappo_unity.runs import checkpoint, rng
from mappo_unity.training import match_series
from mappo_unity.training.collection.slab import SharedBytes
from mappo_unity.training.setup import check_device

SMALL = ["collect.rounds=12", "ppo.minibatch_size=32", "ppo.epochs=2", "log.loggers=[]", "log.progress=false"]
COMMON = [*SMALL, "export_onnx=false", "seed=7", "checkpoint_interval=1", "model.hidden=[16]"]
BALL = ["env=3DBall", "env.num_areas=4"]
SENSES = ["env=custom", "env.factory=sensor_probes:make", "env.params.actions=continuous"]
BY_PART = ["ppo.ratio=component", "ppo.value_norm_update=minibatch", "ppo.normalize_values=running"]
ROOM = ["env=DungeonEscape", "env.num_areas=1"]
RUNS = {
    "3DBall": ([*BALL, "export_onnx=true"], 96),
    "minibatch": ([*BALL, *BY_PART], 96),
    "curious": ([*BALL, "rewards.curiosity.strength=0.1", "rewards.rnd.strength=0.1"], 96),
    "rollback": ([*BALL, "ppo.max_kl=1e-9"], 96),
    "SoccerTwos": (
        ["env=SoccerTwos", "env.num_areas=1", "matches.interval=1", "self_play.save_steps=null"],
        96,
    ),
    "self-play": (
        [
            *("env=SoccerTwos", "env.num_areas=2", "model.memory=gru", "ppo.sequence_length=4"),
            *("matches.interval=null", "self_play.save_steps=1", "self_play.swap_steps=0"),
            *("self_play.play_against_latest_model_ratio=0", "self_play.fixed=[random]"),
        ],
        96,
    ),
    "Hallway": (["env=Hallway", "env.num_areas=2"], 48),
    "DungeonEscape": (ROOM, 72),
    "workers": ([*BALL, "collect.workers=2", "collect.engine=local"], 96),
    "remembering": ([*ROOM, "model.memory=gru", "ppo.sequence_length=4"], 72),
    "corrected": (
        [
            *(*ROOM, *BY_PART, "model.memory=gru", "ppo.sequence_length=4"),
            *("ppo.objective=decoupled", "ppo.advantage=vtrace"),
        ],
        72,
    ),
    "sensors": (
        [*SENSES, "model.goal_conditioning=hyper", "rewards.curiosity.strength=0.1", "collect.rounds=2"],
        128,
    ),
    "sensors, resnet": (
        [*SENSES, "model.critic=poca", "model.image_encoder=resnet", "collect.rounds=2"],
        128,
    ),
    "GridFoodCollector": (["env=GridFoodCollector", "env.num_areas=1", "collect.rounds=6"], 60),
}
"""Options of each run, besides `COMMON`, and the agent decisions of two iterations."""
CRASHING = (
    *("env=custom", "env.factory=test_devices:crashing", "collect.rounds=5"),
    *("ppo.minibatch_size=4", "max_steps=12"),
)
DIVERGED = 4


def train(
    lines: list[str], folder: Path, code: int = 0, cut: bool = False, resumed: Sequence[str] = ()
) -> list[dict[str, str]]:
    """Train for two iterations; return the rows of metrics, and of weights.

    Args:
        code: exit code.
        cut: lose what the second iteration saved, and resume.
        resumed: options to resume with.
    """
    assert train_main([*COMMON, *lines, f"hydra.run.dir={folder}"]) == code
    if cut:
        saved = sorted((folder / "checkpoints").glob("step_*.pt"))
        assert len(saved) == 2
        saved[-1].unlink()
        assert train_main([f"resume={folder}", *resumed]) == code
    return golden_runs.rows_of(folder)


def options(name: str) -> list[str]:
    """Return the options of one of `RUNS`."""
    own, steps = RUNS[name]
    return [*own, f"max_steps={steps}"]


def short_series(make_env: Any, policy: Any, opponent: Any, matches: int, seed: int) -> dict[str, Score]:
    """Play five rounds in the place of a series; what was chosen counts as won."""
    env = make_env(seed)
    env.reset()
    chosen = 0
    for _ in range(5):
        for behavior, spec in env.behavior_specs.items():
            actions = policy.act(behavior, env.get_steps(behavior)[0], spec)
            env.set_actions(behavior, actions)
            chosen += int(actions.discrete.sum())
        env.step()
    env.close()
    return {"all": Score(wins=chosen, losses=1000)}


@pytest.mark.parametrize("name", RUNS)
def test_a_run_on_a_device_is_the_run_on_the_cpu(name: str, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(match_series, "play_matches", short_series)
    code = DIVERGED if name == "rollback" else 0
    wanted = train(options(name), tmp_path / "cpu", code)
    with devices.simulated_device():
        found = train([*options(name), "device=cuda"], tmp_path / "device", code, cut=True)
    assert found == wanted and len(found) == 2
    assert (tmp_path / "device" / "checkpoints" / "final.onnx").is_file() == (name == "3DBall")


def test_batches_of_processes_are_copied_from_pinned_memory(tmp_path: Path) -> None:
    lines = [*BALL, "collect.workers=1", "max_steps=96"]
    wanted = train(lines, tmp_path / "cpu")
    with devices.simulated_device():
        driver = torch.cuda.cudart()
        driver.cudaHostRegister.return_value = 0
        found = train([*lines, "device=cuda"], tmp_path / "device")
        pinned = [call.args for call in driver.cudaHostRegister.call_args_list]
        freed = [call.args[0] for call in driver.cudaHostUnregister.call_args_list]
    assert found == wanted
    assert pinned and all(size > 0 for _, size, _ in pinned)
    assert sorted(address for address, _, _ in pinned) == sorted(freed)


def test_memory_that_cannot_be_pinned_is_used_as_it_is() -> None:
    with devices.simulated_device():
        driver = torch.cuda.cudart()
        driver.cudaHostRegister.return_value = 1  # cudaErrorInvalidValue
        memory = SharedBytes(4096)
        memory.pin()
        memory.bytes[:] = 7
        memory.close()
    assert driver.cudaHostRegister.called and not driver.cudaHostUnregister.called


def test_a_run_goes_on_on_another_device(tmp_path: Path) -> None:
    lines = options("remembering")
    wanted = train(lines, tmp_path / "cpu")
    for folder, first, then in (("to", "cpu", "cuda"), ("from", "cuda", "cpu")):
        with devices.simulated_device():
            found = train(
                [*lines, f"device={first}"], tmp_path / folder, cut=True, resumed=[f"device={then}"]
            )
        assert found == wanted


def crashing(seed: int) -> Any:
    """Return a BaseEnv of an agent that is asked in every result and one that waits; result 7 is a crash."""
    script = [[Record(0, obs=i, reward=i % 3)] + [Record(1, obs=-i)] * (i % 5 == 3) for i in range(40)]
    script[0] += [Record(1)]
    script[7] = [Record(0, ends="interrupted"), Record(1, ends="interrupted"), Record(0), Record(1)]
    env = Fragile(script)
    env.breaks_at, env.cut = 7, (0, 1)
    return env


def test_a_crash_on_a_device_is_a_crash_on_the_cpu(tmp_path: Path, monkeypatch: Any) -> None:
    forgotten: list[int] = []
    void = CarriedRounds.void
    monkeypatch.setattr(CarriedRounds, "void", lambda *args: forgotten.append(void(*args)))
    # this environment has no snapshots: both runs are cut off, and begin it anew
    wanted = train([*CRASHING], tmp_path / "cpu", cut=True)
    with devices.simulated_device():
        found = train([*CRASHING, "device=cuda:0"], tmp_path / "device", cut=True)
    assert found == wanted
    assert forgotten == [1, 1]  # agent 1 waited when the first batch ended


class TestTheSimulatedDevice:
    """What the tests above rest on."""

    def test_it_refuses_what_a_gpu_refuses(self) -> None:
        with devices.simulated_device():
            here, there = torch.ones(3), torch.ones(3, device="cuda")
            for mixed in (
                lambda: here + there,
                lambda: torch.cat([here, there]),
                lambda: torch.where(there > 0, here, 0.0),
                lambda: here.add_(there.sum()),
                lambda: there.masked_fill_(here > 0, 1.0),
                lambda: here[there.long()],
                lambda: there[here.long()],
                lambda: torch.nn.Linear(3, 1)(there),
            ):
                with pytest.raises(devices.MixedDevices):
                    mixed()
            for array in (there.numpy, lambda: np.asarray(there)):
                with pytest.raises(TypeError, match="to numpy"):
                    array()

    def test_what_is_made_of_its_tensors_lies_on_it(self) -> None:
        with devices.simulated_device():
            there = torch.ones(3, device="cuda", requires_grad=True)
            made = [there + 1, there[1:], there.double(), torch.zeros_like(there), there.new_zeros(2)]
            made += [torch.where(there > 0, there, 0.0), there * torch.tensor(2.0), there.clone().detach()]
            (there * 2).sum().backward()
            assert all(x.device == devices.DEVICE and x.is_cuda for x in [*made, there.grad])
            assert there.tolist() == [1.0] * 3 and float(there.detach().sum()) == 3.0

    def test_a_move_is_a_copy(self) -> None:
        with devices.simulated_device():
            here = torch.zeros(3)
            there = here.to("cuda")
            there += 1
            assert here.tolist() == [0.0] * 3 and there.cpu().device == devices.CPU
            assert there.to("cuda:0") is there and here.cpu() is here and here.to(there).is_cuda
            assert torch.nn.Linear(3, 1).to("cuda").weight.is_cuda


def test_the_generators_of_gpus_are_kept(tmp_path: Path) -> None:
    with devices.simulated_device():
        torch.cuda.manual_seed_all(5)
        state = rng.get_rng_state()
        checkpoint.save(tmp_path / "x.pt", {"rng": state | {"cuda": state["cuda"] * 2}})  # of two GPUs
        torch.cuda.manual_seed_all(6)
        rng.set_rng_state(checkpoint.load(tmp_path / "x.pt")["rng"])
        assert torch.cuda.get_rng_state().unique().tolist() == [5]


def test_a_gpu_that_is_not_in_use_is_left_alone(monkeypatch: Any) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: False)
    monkeypatch.setattr(torch.cuda, "get_rng_state_all", lambda: pytest.fail("this starts the GPUs"))
    assert rng.get_rng_state()["cuda"] == []


class TestNames:
    """What `device` may be."""

    @pytest.mark.parametrize("name", ["mps", "cuda:", "cuda:x", "cuda:²", "cpu:0", "CUDA", ""])
    def test_other_names_are_refused(self, name: str, capsys: Any) -> None:
        assert train_main([f"device='{name}'"]) == 2
        assert f"device={name!r} must be one of cpu, cuda, cuda:N" in capsys.readouterr().err

    def test_a_device_that_is_not_there_is_refused(self) -> None:
        assert Config(device="cuda:1").device == "cuda:1"
        with devices.simulated_device():
            for name in ("cpu", "cuda", "cuda:0"):
                check_device(name)
            for name in ("cuda:1", "cuda:99999"):
                with pytest.raises(ConfigError, match=f"device={name}: the last .* finds is cuda:0"):
                    check_device(name)
            with pytest.raises(ConfigError, match="learners=3 with device=cuda needs .* up to cuda:2, but"):
                check_device("cuda", learners=3)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch finds")
@pytest.mark.parametrize("name", [*RUNS, "crash"])
def test_a_run_on_a_gpu(name: str, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(match_series, "play_matches", short_series)
    lines = [*CRASHING] if name == "crash" else options(name)
    code = DIVERGED if name == "rollback" else 0
    rows = train([*lines, "device=cuda"], tmp_path / "run", code, cut=True)
    weights = [float(v) for k, v in rows[-1].items() if k.startswith("weights/")]
    assert len(rows) == 2 and weights and all(map(math.isfinite, weights))
    assert len(checkpoint.load(next((tmp_path / "run" / "checkpoints").glob("step_*.pt")))["rng"]["cuda"]) > 0
