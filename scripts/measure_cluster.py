"""How much faster a recording and an evaluation are on more nodes: nodes of half a core each on this machine.

Run as root on Linux with control groups of version 1, which limit the nodes: python scripts/measure_cluster.py
"""

import tempfile
import time
from pathlib import Path

from ray.cluster_utils import Cluster

from tint_sumo.dataset.recorder import record
from tint_sumo.executors.cluster import RayCluster, ray_cluster
from tint_sumo.study.evaluation_jobs import evaluate_on
from tint_sumo.study.loading import load_policy

CPU_GROUPS = Path("/sys/fs/cgroup/cpu")
PERIOD_US = 100_000
CORES_PER_NODE = 0.5
WINDOWS, EPISODES = 200_000, 1600
MODEL = "oracle"


def limited_cluster(nodes: int) -> Cluster:
    """A head that does no jobs, and nodes that have half a core for all of their processes together."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    for number in range(nodes):
        node = cluster.add_node(num_cpus=1, object_store_memory=200 * 2**20)
        group = CPU_GROUPS / f"tint_sumo_{number}"
        group.mkdir(exist_ok=True)
        (group / "cpu.cfs_period_us").write_text(str(PERIOD_US))
        (group / "cpu.cfs_quota_us").write_text(str(int(CORES_PER_NODE * PERIOD_US)))
        for process in node.all_processes["raylet"]:  # workers are its children, and stay in its group
            (group / "cgroup.procs").write_text(str(process.process.pid))
    return cluster


def recording_s(cluster: RayCluster) -> float:
    began_s = time.perf_counter()
    with tempfile.TemporaryDirectory() as out:
        record(out, WINDOWS, workers=cluster, progress=False)
    return time.perf_counter() - began_s


def evaluation_s(cluster: RayCluster) -> float:
    began_s = time.perf_counter()
    evaluate_on(cluster, MODEL, load_policy(MODEL), {"p_conservative": 0.4}, EPISODES, 0, progress=False)
    return time.perf_counter() - began_s


def main() -> None:
    print("nodes  recording  efficiency  evaluation  efficiency")
    alone: list[float] = []
    for nodes in (1, 2, 4):
        cluster = limited_cluster(nodes)
        with ray_cluster(cluster.address) as found:
            times_s = [recording_s(found), evaluation_s(found)]
        cluster.shutdown()
        alone = alone or times_s
        shares = [one / (nodes * spent) for one, spent in zip(alone, times_s, strict=True)]
        print(f"{nodes:5}  {times_s[0]:7.1f} s  {shares[0]:10.0%}  {times_s[1]:8.1f} s  {shares[1]:10.0%}", flush=True)


if __name__ == "__main__":
    main()
