"""Measure how much faster a recording and an evaluation are on more nodes: nodes of 0.4 cores each on this machine.

Run as root on Linux with control groups of version 1, which limit the nodes: python scripts/measure_cluster.py
"""

import tempfile
import time
from pathlib import Path
from statistics import median

from ray.cluster_utils import Cluster

from tint_sumo.config import Mix
from tint_sumo.dataset.recorder import record
from tint_sumo.envs import TaskSettings
from tint_sumo.jobs.cluster import RayCluster, ray_cluster
from tint_sumo.methods.evaluation_jobs import evaluate_on

CPU_GROUPS = Path("/sys/fs/cgroup/cpu")
PERIOD_US = 100_000
CORES_PER_NODE = 0.4  # four of them leave a part of two cores to the head and to the command
WINDOWS, EPISODES = 400_000, 3200
REPEATS = 3
MODEL = "oracle"


def limited_cluster(nodes: int) -> Cluster:
    """A head that does no jobs, and nodes that have 0.4 cores for all of their processes together."""
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
    evaluate_on(cluster, MODEL, TaskSettings(p_conservative=Mix(0.4)), EPISODES, 0, progress=False)
    return time.perf_counter() - began_s


def times_s(nodes: int) -> tuple[float, float]:
    """On a cluster that has just started."""
    cluster = limited_cluster(nodes)
    try:
        with ray_cluster(cluster.address) as found:
            return recording_s(found), evaluation_s(found)
    finally:
        cluster.shutdown()  # type: ignore[no-untyped-call]  # Ray has no types here


def main() -> None:
    times_s(2)  # reads the libraries from the disk
    print("nodes  recording  efficiency  evaluation  efficiency  all runs")
    alone: list[float] = []
    for nodes in (1, 2, 4):
        runs = [times_s(nodes) for _ in range(REPEATS)]
        medians_s = [median(of_kind) for of_kind in zip(*runs, strict=True)]
        alone = alone or medians_s
        shares = [alone_s / (nodes * spent) for alone_s, spent in zip(alone, medians_s, strict=True)]
        columns = "".join(f"  {took:7.1f} s  {share:10.0%}" for took, share in zip(medians_s, shares, strict=True))
        print(f"{nodes:5}{columns}  {runs}", flush=True)


if __name__ == "__main__":
    main()
