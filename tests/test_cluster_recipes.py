"""The recipes for clusters in ``examples/cluster``, as far as one machine can try them."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

ROOT = Path(__file__).parents[1]
CLUSTER = ROOT / "examples" / "cluster"
PATIENCE_S = 120.0

# Both stand in for SLURM's own commands and note how they were called. This srun has one machine for all nodes.
SRUN = """#!/usr/bin/env bash
echo "$*" >> "$CALLS"
while [[ $1 == --* ]]; do shift; done
exec "$@"
"""
SCONTROL = """#!/usr/bin/env bash
echo "scontrol $*" >> "$CALLS"
"""

# Runs on the cluster as the user's command would: it waits for both nodes, and runs a job on each.
ON_TWO_NODES = """
import json, os, subprocess, sys, time
from pathlib import Path
import ray

ray.init(address="auto", log_to_driver=False)
while ray.cluster_resources().get("CPU") != 2:
    time.sleep(0.2)

@ray.remote(num_cpus=1)
def node():
    time.sleep(1)
    return ray.get_runtime_context().get_node_id()

nodes = set(ray.get([node.remote() for _ in range(2)]))
stranger = subprocess.run(
    ["ray", "status", "--address", os.environ["RAY_ADDRESS"]],
    env=os.environ | {"RAY_AUTH_TOKEN": "0" * 64}, capture_output=True, text=True, timeout=60,
)
found = {"nodes": len(nodes), "stranger": stranger.returncode, "said": stranger.stdout + stranger.stderr}
Path(sys.argv[1]).write_text(json.dumps(found))
sys.exit(7)
"""


class Slurm:
    """A machine that looks to ``slurm.sh`` like the first node of a job of SLURM."""

    def __init__(self, folder: Path) -> None:
        self.job = str(os.getpid())
        self.calls = folder / "calls"
        self._environment = os.environ | {
            "PATH": f"{folder}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "HOME": str(folder),  # where Ray keeps the token
            "CALLS": str(self.calls),
            "SLURM_JOB_ID": self.job,
            "SLURM_CPUS_PER_TASK": "1",
            "SLURMD_NODENAME": "node1",
        }
        for name, text in (("srun", SRUN), ("scontrol", SCONTROL)):
            (folder / name).write_text(text)
            (folder / name).chmod(0o755)

    def start(self, nodes: int, *command: str) -> "subprocess.Popen[str]":
        environment = self._environment | {"SLURM_JOB_NUM_NODES": str(nodes)}
        script = str(CLUSTER / "slurm.sh")
        return subprocess.Popen([script, *command], env=environment, stderr=subprocess.PIPE, text=True)

    def processes(self) -> list[psutil.Process]:
        """All processes of the job that run."""
        found = []
        for process in psutil.process_iter():
            try:
                if process.environ().get("SLURM_JOB_ID") == self.job and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
            except psutil.Error:
                continue
        return found


@pytest.fixture
def slurm(tmp_path: Path) -> Iterator[Slurm]:
    machine = Slurm(tmp_path)
    yield machine
    for process in machine.processes():
        process.kill()
    shutil.rmtree(f"/tmp/ray-{machine.job}", ignore_errors=True)


@pytest.mark.slow
def test_slurm_runs_a_command_on_all_nodes_and_ends_ray(slurm: Slurm, tmp_path: Path) -> None:
    (tmp_path / "command.py").write_text(ON_TWO_NODES)
    process = slurm.start(2, sys.executable, str(tmp_path / "command.py"), str(tmp_path / "found.json"))
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 7, errors
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["nodes"] == 2
    assert found["stranger"] != 0 and "token" in found["said"], "Ray takes orders only from those who know the token"
    assert (tmp_path / ".ray" / "auth_token").stat().st_mode & 0o077 == 0
    head, workers = slurm.calls.read_text().splitlines()  # and no scontrol
    assert "--nodes=1" in head and "--nodelist=node1" in head
    assert "--nodes=1" in workers and "--exclude=node1" in workers
    assert not slurm.processes()


@pytest.mark.slow
def test_slurm_puts_a_command_back_into_the_queue_before_its_time_is_over(slurm: Slurm, tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    process = slurm.start(1, "bash", "-c", f"touch {begun}; exec sleep 1000")
    deadline = time.monotonic() + PATIENCE_S
    while not begun.exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGUSR1)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 128 + signal.SIGTERM
    assert slurm.calls.read_text().splitlines()[-1] == f"scontrol requeue {slurm.job}"
    assert not slurm.processes()


def test_slurm_tells_how_to_use_it(slurm: Slurm) -> None:
    process = slurm.start(1)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert "sbatch" in errors
    assert not slurm.calls.exists()
