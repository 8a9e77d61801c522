"""Tasks on a Ray cluster: what a lost machine had begun is done again elsewhere."""

import os
import time
from pathlib import Path
from typing import Any

import pytest

from distrace.processes import parallel_map


@pytest.fixture(scope="module")
def cluster() -> Any:
    """Two nodes of one core each, on this machine."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    nodes.add_node(num_cpus=1)
    before = os.environ.get("RAY_ADDRESS")
    yield nodes
    ray.shutdown()
    nodes.shutdown()
    assert os.environ.get("RAY_ADDRESS") == before


@pytest.mark.slow
def test_nothing_is_lost_with_a_machine(cluster: Any, tmp_path: Path) -> None:
    second = next(node for node in cluster.list_all_nodes() if node is not cluster.head_node)

    def work(task: int) -> tuple[int, str]:
        import ray

        (tmp_path / f"{task}-{time.time_ns()}").touch()
        time.sleep(1.0)
        return task, ray.get_runtime_context().get_node_id()

    results = []
    for result in parallel_map(work, range(8), 1, cluster.address):
        results.append(result)
        if len({node for _, node in results}) == 2 and second is not None:
            time.sleep(0.5)  # it has begun another task
            cluster.remove_node(second, allow_graceful=False)
            second = None
    assert second is None, "both machines had work"
    assert sorted(task for task, _ in results) == list(range(8))
    assert len(list(tmp_path.iterdir())) > 8, "what the lost machine had begun was done again"


@pytest.mark.slow
def test_an_error_of_a_task_is_its_own(cluster: Any) -> None:
    def refuse(task: int) -> int:
        raise ValueError(f"{task} is no task")

    with pytest.raises(ValueError, match="3 is no task"):
        list(parallel_map(refuse, [3], 1, cluster.address))


@pytest.mark.slow
def test_where_no_cluster_answers_one_sentence_says_so() -> None:
    ray = pytest.importorskip("ray")
    ray.shutdown()
    with pytest.raises(ValueError, match="no Ray cluster answers there"):
        list(parallel_map(abs, [1], 1, "127.0.0.1:1"))
