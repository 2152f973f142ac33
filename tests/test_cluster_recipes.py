"""The recipes for clusters in ``examples/cluster``, as far as one machine can try them."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.waiting import PATIENCE_S, wait_until
from tint_sumo.cli.command import SpreadCommand
from tint_sumo.cli.command_line import parse

ROOT = Path(__file__).parents[1]
CLUSTER = ROOT / "examples" / "cluster"

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

    def processes(self) -> list[int]:
        """The processes of the job that still run."""
        variable = f"SLURM_JOB_ID={self.job}".encode()
        found = []
        for file in Path("/proc").glob("[0-9]*/environ"):
            with suppress(OSError):  # it has ended meanwhile
                if variable in file.read_bytes().split(b"\0"):
                    found.append(int(file.parent.name))
        return found

    def wait_until_over(self) -> None:
        """Wait until no process of the job is left. A helper of Ray's dashboard ends ten seconds after the others."""
        wait_until(lambda: not self.processes())


@pytest.fixture
def slurm(tmp_path: Path) -> Iterator[Slurm]:
    machine = Slurm(tmp_path)
    yield machine
    for process in machine.processes():
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.kill(process, signal.SIGKILL)
    shutil.rmtree(f"/tmp/ray-{machine.job}", ignore_errors=True)


@pytest.mark.long
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
    slurm.wait_until_over()


@pytest.mark.slow
def test_slurm_puts_a_command_back_into_the_queue_before_its_time_is_over(slurm: Slurm, tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    process = slurm.start(1, "bash", "-c", f"touch {begun}; exec sleep 1000")
    wait_until(begun.exists, process)
    process.send_signal(signal.SIGUSR1)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 128 + signal.SIGTERM
    assert slurm.calls.read_text().splitlines()[-1] == f"scontrol requeue {slurm.job}"


def test_slurm_tells_how_to_use_it(slurm: Slurm) -> None:
    process = slurm.start(1)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert "sbatch" in errors
    assert not slurm.calls.exists()


def test_slurm_tells_that_ray_did_not_start(slurm: Slurm, tmp_path: Path) -> None:
    (tmp_path / "srun").write_text("#!/usr/bin/env bash\nexit 1\n")
    process = slurm.start(1, "touch", str(tmp_path / "begun"))
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "Ray did not start on node1" in errors
    assert not (tmp_path / "begun").exists()


# Ray's cluster launcher


def test_the_launcher_takes_its_recipe() -> None:
    util = pytest.importorskip("ray.autoscaler._private.util")
    config = util.prepare_config(yaml.safe_load((CLUSTER / "launcher.yaml").read_text()))
    util.validate_config(config)
    with pytest.raises(Exception, match="max_workers"):
        util.validate_config(config | {"max_workers": "many"})
    assert config["available_node_types"]["worker"]["max_workers"] == 8
    for local in config["file_mounts"].values():
        assert local.startswith("~") or (ROOT / local).exists()
    head, *_ = [command for command in config["head_start_ray_commands"] if "--head" in command]
    assert "--dashboard-host=127.0.0.1" in head
    assert any("RAY_AUTH_MODE=token" in command for command in config["setup_commands"])
    assert "SecurityGroup" not in str(config), "Ray's own lets in nothing but ssh"


# Kubernetes


@pytest.fixture
def manifests() -> dict[str, dict[str, Any]]:
    documents = yaml.safe_load_all((CLUSTER / "kuberay.yaml").read_text())
    return {document["kind"]: document for document in documents}


def test_the_manifest_asks_for_a_head_and_eight_workers(manifests: dict[str, dict[str, Any]]) -> None:
    job = manifests["RayJob"]
    assert job["apiVersion"] == "ray.io/v1"
    cluster = job["spec"]["rayClusterSpec"]
    head, (workers,) = cluster["headGroupSpec"], cluster["workerGroupSpecs"]
    assert workers["replicas"] == workers["minReplicas"] == workers["maxReplicas"] == 8
    for group in (head, workers):
        (container,) = group["template"]["spec"]["containers"]
        assert container["resources"]["limits"] == {"cpu": "2", "memory": "4Gi"}
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
    pod = head["template"]["spec"]
    (volume,), (mount,) = pod["volumes"], pod["containers"][0]["volumeMounts"]
    claim = manifests["PersistentVolumeClaim"]["metadata"]["name"]
    assert volume["persistentVolumeClaim"]["claimName"] == claim
    assert f"--out {mount['mountPath']}/" in job["spec"]["entrypoint"]


def test_only_the_namespace_and_the_operator_reach_the_pods(manifests: dict[str, dict[str, Any]]) -> None:
    cluster = manifests["RayJob"]["spec"]["rayClusterSpec"]
    assert cluster["headGroupSpec"]["serviceType"] == "ClusterIP"
    assert cluster["authOptions"] == {"mode": "token"}
    assert "Ingress" not in manifests
    policy = manifests["NetworkPolicy"]["spec"]
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        assert policy["podSelector"]["matchLabels"].items() <= group["template"]["metadata"]["labels"].items()
        assert group["template"]["spec"]["securityContext"]["runAsNonRoot"]
    namespace, operator = policy["ingress"]
    assert namespace == {"from": [{"podSelector": {}}]}
    assert operator["ports"] == [{"port": 8265}]


def test_all_recipes_have_the_same_versions(manifests: dict[str, dict[str, Any]]) -> None:
    launcher = (CLUSTER / "launcher.yaml").read_text()
    rays = re.findall(r"ray\[[\w,]+\]==([\d.]+)", (CLUSTER / "Dockerfile").read_text() + launcher)
    assert len(rays) == 3
    assert {manifests["RayJob"]["spec"]["rayClusterSpec"]["rayVersion"], *rays} == {rays[0]}
    image = (ROOT / "Dockerfile").read_text()
    torches = re.findall(r"torch==([\d.]+\d)", image + launcher + (ROOT / "Makefile").read_text())
    assert len(set(torches)) == 1
    libraries = re.findall(r"install (?:-y -qq|--yes --no-install-recommends) ([\w ]+)", image + launcher)
    assert len(libraries) == 2
    assert libraries[0].split() == libraries[1].split()


def test_the_launcher_copies_all_that_the_package_is_built_from() -> None:
    copied = re.findall(r"^COPY (.+) \S+$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    mounted = yaml.safe_load((CLUSTER / "launcher.yaml").read_text())["file_mounts"].values()
    assert {part for group in copied for part in group.split()} == {one for one in mounted if not one.startswith("~")}


def test_the_image_of_the_cluster_stands_on_that_of_the_command() -> None:
    """Kubernetes wants the number of a user who is not root, and Ray starts programs of its own."""
    lines = (CLUSTER / "Dockerfile").read_text().splitlines()
    assert "FROM tint-sumo" in lines and "ENTRYPOINT []" in lines
    assert [line for line in lines if line.startswith("USER")][-1] == "USER 1000"


def test_the_commands_in_the_recipes_are_understood() -> None:
    texts = [file.read_text(encoding="utf-8") for file in CLUSTER.iterdir() if file.is_file()]
    found = {line for text in texts for line in re.findall(r"tint-sumo (study run [^'\"\n]*)", text)}
    assert found
    for line in found:
        command = parse(shlex.split(line.split(">&2")[0]))
        assert isinstance(command, SpreadCommand)
        assert command.executor == "ray"
