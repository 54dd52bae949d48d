"""A cluster of Ray nodes on this machine."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

PROBE = "import ray; ray.init(address='local', include_dashboard=False); ray.get(ray.remote(lambda: 1).remote())"
_NODE_CPUS = 1


def skip_unless_ray_starts() -> None:
    """Skip where Ray cannot start at all, such as in a sandbox without shared memory."""
    try:
        subprocess.run([sys.executable, "-c", PROBE], check=True, capture_output=True, timeout=120)
    except (subprocess.SubprocessError, OSError) as error:
        pytest.skip(f"Ray does not start on this machine: {error}")


@contextmanager
def ray_cluster(nodes: int) -> Iterator[Any]:
    """Start the nodes; the first one is the head."""
    cluster = _start(nodes)
    try:
        yield cluster
    finally:
        import ray

        ray.shutdown()
        cluster.shutdown()


def _start(nodes: int, attempts: int = 3) -> Any:
    """Ray gives each node 30 s to start, which a busy machine can exceed; then all are started again."""
    from ray.cluster_utils import Cluster

    arguments = {"num_cpus": _NODE_CPUS, "object_store_memory": 100 << 20}
    cluster = Cluster()
    try:
        cluster.add_node(**arguments, include_dashboard=False)
        for _ in range(nodes - 1):
            cluster.add_node(**arguments)
    except Exception as error:
        cluster.shutdown()
        if attempts == 1 or "timed out during startup" not in str(error):
            raise
        return _start(nodes, attempts - 1)
    return cluster
