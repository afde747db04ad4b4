"""Train multi-agent policies (MAPPO) on Unity ML-Agents environments.

Set before torch is imported, unless the environment says otherwise: threads of OpenMP that wait for each
other sleep instead of spinning. Where a core is shared, two that spin learn several times slower than one.
"""

import os

__version__ = "0.2.0"

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
