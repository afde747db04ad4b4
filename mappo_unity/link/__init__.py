"""The ML-Agents protocol (API 1.5.0) between a trainer and Unity players, from both ends.

`messages` and `rows`: bytes on the wire. `server`, `process`, `client`: a trainer's side, one running player
as a BaseEnv. `restarts`, `several`: players that fail, and many of them. Knows nothing of learning.
"""

import os

from mappo_unity.protobuf import install

# No child of ours uses gRPC before it execs. Its fork handlers run in every child all the same (players that
# are started again, ffmpeg), and now and then kill it there; gRPC reads this when it is imported.
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")

install()
