"""mlagents_envs on a compiled protobuf, each time in a fresh interpreter: imports are process-wide."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from mappo_unity.protocol.protobuf import read_serialized_file


def run_fresh(code: str) -> str:
    """Run code in a new interpreter and return what it printed."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_without_install_the_import_fails() -> None:
    """The reason for the module: should this begin to pass, the module can go."""
    code = "import mlagents_envs.communicator_objects.unity_message_pb2"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode != 0
    assert "Descriptors cannot be created directly" in done.stderr


def test_environment_imports_on_upb_beside_tensorboard() -> None:
    out = run_fresh("""
from mappo_unity.protocol.protobuf import install
install()
from mlagents_envs.environment import UnityEnvironment
from mlagents_envs.side_channel.engine_configuration_channel import EngineConfigurationChannel
from tensorboard.compat.proto import event_pb2
from google.protobuf.internal import api_implementation
from mlagents_envs.communicator_objects.unity_message_pb2 import UnityMessageProto
print(api_implementation.Type(), UnityEnvironment.API_VERSION, type(UnityMessageProto.DESCRIPTOR).__module__)
""")
    assert out.split() == ["upb", "1.5.0", "google._upb._message"]


def test_install_is_idempotent() -> None:
    out = run_fresh("""
import sys
from mappo_unity.protocol.protobuf import install
install(); install()
import mlagents_envs.environment
install()
print([type(finder).__name__ for finder in sys.meta_path].count("_OldPb2Finder"))
""")
    assert out == "1"


def test_every_module_of_the_package_loads() -> None:
    out = run_fresh("""
import importlib, pkgutil
from mappo_unity.protocol.protobuf import install
install()
import mlagents_envs.communicator_objects as package
names = sorted(info.name for info in pkgutil.iter_modules(package.__path__))
for name in names:
    module = importlib.import_module(f"{package.__name__}.{name}")
    if name.endswith("_pb2"):
        assert module.DESCRIPTOR.name == f"mlagents_envs/communicator_objects/{name[:-4]}.proto", name
        assert module.__file__.endswith(f"{name}.py")
        for message in module.DESCRIPTOR.message_types_by_name:
            assert getattr(module, message).__module__ == module.__name__
from mlagents_envs.communicator_objects.unity_to_external_pb2_grpc import UnityToExternalProtoStub
import grpc
stub = UnityToExternalProtoStub(grpc.insecure_channel("localhost:1"))
print(len(names), hasattr(stub, "Exchange"))
""")
    assert out == "22 True"


def test_unity_message_round_trip() -> None:
    """The wire bytes are worked out by hand from the .proto files (status = 1, id = 10)."""
    out = run_fresh("""
import pickle
from mappo_unity.protocol.protobuf import install
install()
from mlagents_envs.communicator_objects.agent_info_pb2 import AgentInfoProto
from mlagents_envs.communicator_objects.observation_pb2 import NONE, ObservationProto
from mlagents_envs.communicator_objects.unity_message_pb2 import UnityMessageProto
message = UnityMessageProto()
message.header.status = 200
agents = message.unity_output.rl_output.agentInfos["3DBall?team=0"].value
agent = agents.add(id=7, reward=0.5, done=True, max_step_reached=True, action_mask=[True, False])
numbers = ObservationProto.FloatData(data=[1.0, -2.5, 0.25])
agent.observations.add(shape=[3], compression_type=NONE, float_data=numbers)
again = UnityMessageProto.FromString(message.SerializeToString())
assert again == message and pickle.loads(pickle.dumps(message)) == message
back = again.unity_output.rl_output.agentInfos["3DBall?team=0"].value[0]
print(again.header.status, back.id, back.reward, list(back.action_mask), back.observations[0].float_data.data)
for plain in (UnityMessageProto(header={"status": 200}), AgentInfoProto(id=7)):
    print(plain.SerializeToString().hex())
""")
    assert out.splitlines() == ["200 7 0.5 [True, False] [1.0, -2.5, 0.25]", "0a0308c801", "5007"]


@pytest.mark.parametrize(
    ("source", "serialized"),
    [
        (r"D = F(name='x', serialized_pb=b'\n\x01x')", b"\n\x01x"),
        (r"D = F(name='x', serialized_pb=_b('\n\xff\"'))", b'\n\xff"'),
        ("D = pool.AddSerializedFile(b'x')", None),
        ("D = F(serialized_pb=read())", None),
    ],
)
def test_serialized_file_is_read_without_running_it(
    source: str, serialized: bytes | None, tmp_path: Path
) -> None:
    path = tmp_path / "x_pb2.py"
    path.write_text(f"raise SystemExit\n{source}\n")
    assert read_serialized_file(path) == serialized
