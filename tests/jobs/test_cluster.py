"""A real Ray cluster of several nodes on this machine, whose nodes come, work and die."""

import os
import random
import signal
import socket
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from tests.dataset.test_recorder import TWO_SHARDS, contents
from tests.jobs.jobs import CountJob, FileJob
from tests.waiting import PATIENCE_S, wait_until
from tint_sumo.cli import main
from tint_sumo.config import Mix, PpoSettings
from tint_sumo.core.checkpoints import CHECKPOINT_FILE
from tint_sumo.core.errors import InputError, JobError
from tint_sumo.core.stores import Store
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.schema import MANIFEST
from tint_sumo.envs import TaskSettings
from tint_sumo.jobs import Executor, Local
from tint_sumo.jobs.process import log_path
from tint_sumo.methods.evaluation import evaluate
from tint_sumo.methods.evaluation_jobs import evaluate_on
from tint_sumo.methods.loading import load_policy
from tint_sumo.study.budgets import Budget, Conditions, Trials
from tint_sumo.study.jobs import EvaluateJob, TrainJob
from tint_sumo.study.plan import plan

pytest.importorskip("ray", reason="Ray is not installed: pip install 'tint_sumo[ray]'")

from ray.cluster_utils import Cluster

from tint_sumo.jobs.cluster import LOOK_INTERVAL_S, _FileStore, _versions, ray_cluster

NODES = 3
MANY_WINDOWS = 150_000  # some seconds' work, on a fast machine, too


class Nodes:
    """A head node that does no jobs, and nodes of one CPU each that do."""

    def __init__(self) -> None:
        # A dead node is noticed within a second or two, not within half a minute. Jobs do not give way to other work.
        health = {"initial_delay_ms": 0, "period_ms": 500, "failure_threshold": 2}
        system = {"worker_niceness": 0} | {f"health_check_{name}": value for name, value in health.items()}
        head = {"num_cpus": 0, "include_dashboard": False, "_system_config": system, **self._small()}
        self._cluster = Cluster(initialize_head=True, head_node_args=head)
        self.workers: list[Any] = []
        self.restore()

    def _small(self) -> dict[str, Any]:
        return {"object_store_memory": 100 * 2**20}

    @property
    def address(self) -> str:
        return str(self._cluster.address)

    def add(self) -> None:
        self.workers.append(self._cluster.add_node(num_cpus=1, **self._small()))

    def kill(self, index: int) -> None:
        """With SIGKILL, as if the machine had gone."""
        self._cluster.remove_node(self.workers.pop(index), allow_graceful=False)

    def restore(self) -> None:
        while len(self.workers) < NODES:
            self.add()

    def end(self) -> None:
        self._cluster.shutdown()


@pytest.fixture(scope="module")
def nodes() -> Iterator[Nodes]:
    made = Nodes()
    yield made
    made.end()


@pytest.fixture(scope="module")
def connected(nodes: Nodes) -> Iterator[Executor]:
    """The nodes keep the processes of one connection, which would import PyTorch anew for each of them."""
    with ray_cluster(nodes.address) as found:
        yield found


@pytest.fixture
def cluster(nodes: Nodes, connected: Executor) -> Executor:
    nodes.restore()
    return connected


@pytest.fixture(scope="module")
def many_shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset that takes three nodes several seconds."""
    folder = tmp_path_factory.mktemp("many_shards")
    record(folder, MANY_WINDOWS, workers=2, progress=False)
    return folder


@contextmanager
def meanwhile(work: Callable[[], Any]) -> Iterator[None]:
    """Do some work in a thread while the block runs, and wait for its end; nodes can begin in the main thread only."""
    with ThreadPoolExecutor(1) as thread:
        future = thread.submit(work)
        try:
            yield
        finally:  # the work's own error says more than that of a block that waited for it
            future.result()


def test_jobs_read_what_others_wrote_on_other_nodes(cluster: Executor, tmp_path: Path) -> None:
    jobs = [FileJob("last", tmp_path, needs=("base", "other")), FileJob("base", tmp_path), FileJob("other", tmp_path)]
    cluster.run(jobs, progress=False)
    assert [job.path("done").read_text() for job in jobs] == ["", "", ""]
    assert len({job.path("pid").read_text() for job in jobs}) == 3
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize(("failure", "error", "tries"), [("refused", InputError, 1), ("died", JobError, 3)])
def test_a_job_that_fails_is_named_and_the_others_finish(
    cluster: Executor, tmp_path: Path, failure: str, error: type[Exception], tries: int
) -> None:
    bad, good = FileJob("bad", tmp_path, failure=failure), FileJob("good", tmp_path)
    child = FileJob("child", tmp_path, needs=("bad",))
    with pytest.raises(error, match=r"bad: .*; skipped, because they need these: child") as caught:
        cluster.run([bad, good, child], progress=False)
    assert ("this is not for me" if failure == "refused" else "exit code 7") in str(caught.value)
    assert (bad.tries, good.is_done(), child.tries) == (tries, True, 0)
    log = (tmp_path / "logs" / "bad.log").read_text()
    assert log == ("this is not for me\n" if failure == "refused" else "")


def test_a_node_with_other_versions_does_nothing(
    cluster: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = version("torch").partition("+")[0]
    with monkeypatch.context() as other:
        other.setattr("tint_sumo.jobs.cluster._versions", lambda: _versions() | {"torch": "1.0"})
        job = FileJob("one", tmp_path)
        text = f"a node of the cluster has torch {own}, and this machine has torch 1.0; install the same everywhere"
        with pytest.raises(InputError, match=text):
            cluster.run([job], progress=False)
        with pytest.raises(InputError, match=text):
            record(tmp_path / "data", 100, workers=cluster, progress=False)
    assert job.tries == 0


def test_a_recording_is_the_same_byte_for_byte(cluster: Executor, two_shards: Path, tmp_path: Path) -> None:
    record(tmp_path, TWO_SHARDS, workers=cluster, progress=False)
    assert not (tmp_path / "fcd").exists()
    record(tmp_path, TWO_SHARDS, workers=cluster, fcd=True, progress=False)
    assert contents(tmp_path) == contents(two_shards)
    assert (tmp_path / MANIFEST).read_bytes() == (two_shards / MANIFEST).read_bytes()


def test_a_recording_survives_a_node(nodes: Nodes, cluster: Executor, many_shards: Path, tmp_path: Path) -> None:
    with meanwhile(lambda: record(tmp_path, MANY_WINDOWS, workers=cluster, progress=False)):
        wait_until((tmp_path / "drivers" / "shard-00000.parquet").exists)
        nodes.kill(0)
    assert len(nodes.workers) == NODES - 1
    assert contents(tmp_path) == contents(many_shards)


def test_a_job_goes_on_from_what_it_had_left_when_its_node_dies(
    nodes: Nodes, cluster: Executor, tmp_path: Path
) -> None:
    gate = tmp_path / "gate"
    jobs = [CountJob(f"count{number}", tmp_path, 20, gate) for number in range(NODES)]

    with meanwhile(lambda: cluster.run(jobs, progress=False)):
        wait_until(lambda: all(job.numbers for job in jobs))
        nodes.kill(0)
        nodes.add()
        wait_until(lambda: any(len(job.begins) == 2 for job in jobs))
        gate.touch()
    assert [job.numbers for job in jobs] == [list(range(20))] * NODES
    begins = sorted(job.begins for job in jobs)
    assert begins[:-1] == [[0]] * (NODES - 1)
    first, second = begins[-1]
    assert first == 0 < second


def test_a_node_does_one_job_at_a_time_and_one_that_joins_is_used(
    nodes: Nodes, cluster: Executor, tmp_path: Path
) -> None:
    gate = tmp_path / "gate"
    jobs = [CountJob(f"count{number}", tmp_path, 2, gate) for number in range(NODES + 2)]

    def begun() -> int:
        return sum(bool(job.numbers) for job in jobs)

    with meanwhile(lambda: cluster.run(jobs, progress=False)):
        wait_until(lambda: begun() >= NODES)
        time.sleep(2 * LOOK_INTERVAL_S)  # all jobs have sent their news meanwhile
        assert begun() == NODES
        nodes.add()
        wait_until(lambda: begun() == NODES + 1)
        gate.touch()
    nodes.kill(0)


@pytest.mark.slow
def test_a_study_is_the_same_file_for_file(cluster: Executor, brief: PpoSettings, tmp_path: Path) -> None:
    budget = Budget(
        traits=None,
        ppo=brief,
        methods=("always_go", "oracle"),
        mixes=(Mix(0.4),),
        seeds=(0,),
        trials=(Trials((Conditions(Mix(0.4)), Conditions(Mix(0.4), percent=50)), 3),),
    )
    here, there = tmp_path / "here", tmp_path / "there"
    Local(2).run(plan(budget, here), progress=False)
    cluster.run(plan(budget, there), progress=False)
    made = files(here)
    assert {"ceilings.json", "results/always_go.json", "policies/oracle-P0.4-seed0/policy.safetensors"} <= made.keys()
    assert files(there) == made


def files(out: Path) -> dict[str, bytes]:
    """What a study has made, without its logs and what TensorBoard shows, which tell the time."""
    made = {str(file.relative_to(out)): file for file in out.rglob("*") if file.is_file()}
    timed = ("logs/", "tensorboard", ".lock")
    return {path: file.read_bytes() for path, file in made.items() if not any(part in path for part in timed)}


@pytest.mark.slow
@pytest.mark.long
def test_a_training_survives_a_node_with_its_checkpoint(
    nodes: Nodes, cluster: Executor, brief: PpoSettings, tmp_path: Path
) -> None:
    """It takes longer than the 15 s between two checkpoints, and ends as if nothing had happened."""
    settings = replace(brief, total_steps=64 * 1800)
    here, job = (TrainJob("no_labels", Mix(0.4), 0, settings, True, tmp_path / name) for name in ("here", "there"))
    Local(1).run([here], progress=False)
    with meanwhile(lambda: cluster.run([job], progress=False)):
        wait_until((job.folder / CHECKPOINT_FILE).exists)
        for _ in range(NODES):  # one of them does the job
            nodes.kill(0)
        nodes.add()
    assert job.is_done()
    assert files(job.folder) == files(here.folder)


@pytest.mark.slow
@pytest.mark.long
def test_an_evaluation_survives_a_node(nodes: Nodes, cluster: Executor, tmp_path: Path) -> None:
    trials = (Trials((Conditions(Mix(0.4)),), 600),)
    here, there = (EvaluateJob("oracle", None, 0, trials, tmp_path / name) for name in ("here", "there"))
    Local(1).run([here], progress=False)
    with meanwhile(lambda: cluster.run([there], progress=False)):
        wait_until((there.out / log_path(there.name)).exists)
        assert not there.is_done()
        for _ in range(NODES):  # one of them does the job
            nodes.kill(0)
        nodes.add()
    assert there.result_file.read_bytes() == here.result_file.read_bytes()


DRIVER = """
import sys
from pathlib import Path
from tests.jobs.jobs import CountJob
from tint_sumo.jobs.cluster import ray_cluster

if __name__ == "__main__":
    address, out = sys.argv[1], Path(sys.argv[2])
    jobs = [CountJob(name, out, 20, out / "gate") for name in ("first", "second")]
    try:
        with ray_cluster(address) as cluster:
            cluster.run(jobs)
    except KeyboardInterrupt:
        sys.exit(130)
"""


def driver(nodes: Nodes, out: Path) -> "subprocess.Popen[bytes]":
    script = out / "driver.py"
    script.write_text(DRIVER)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path.cwd()), os.environ.get("PYTHONPATH", "")])}
    return subprocess.Popen([sys.executable, str(script), nodes.address, str(out)], env=environment)


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_a_driver_that_ends_goes_on_with_the_same_call(nodes: Nodes, tmp_path: Path, sent: signal.Signals) -> None:
    nodes.restore()
    jobs = [CountJob(name, tmp_path, 20) for name in ("first", "second")]
    process = driver(nodes, tmp_path)
    wait_until(lambda: all(job.numbers for job in jobs))
    process.send_signal(sent)
    assert process.wait(PATIENCE_S) == (-sent if sent == signal.SIGKILL else 130)
    left = [len(job.numbers) for job in jobs]
    assert all(0 < count < 20 for count in left)
    (tmp_path / "gate").touch()
    assert driver(nodes, tmp_path).wait(PATIENCE_S) == 0
    assert [job.numbers for job in jobs] == [list(range(20))] * 2
    assert [job.begins for job in jobs] == [[0, count] for count in left]


@pytest.mark.slow
@pytest.mark.long
def test_twenty_kills_lose_nothing(nodes: Nodes, cluster: Executor, many_shards: Path, tmp_path: Path) -> None:
    """Nodes die at random moments, some of them before they have begun to work, and others join."""
    moments = random.Random(0)
    recorded = tmp_path / "dataset"
    jobs = [CountJob(f"count{number}", tmp_path, 120) for number in range(3 * NODES)]

    def work() -> None:
        record(recorded, MANY_WINDOWS, workers=cluster, progress=False)
        cluster.run(jobs, progress=False)

    kills_in = {"the recording": 0, "the jobs": 0}
    with meanwhile(work):
        while not all(job.is_done() for job in jobs):
            time.sleep(moments.uniform(0.0, 1.5))
            kills_in["the jobs" if (recorded / MANIFEST).exists() else "the recording"] += 1
            nodes.kill(moments.randrange(NODES))
            nodes.add()
    assert contents(recorded) == contents(many_shards)
    assert [job.numbers for job in jobs] == [list(range(120))] * (3 * NODES)
    assert min(kills_in.values()) >= 3
    assert sum(kills_in.values()) >= 20


LISTENING = """
import psutil
from tint_sumo.jobs.cluster import ray_cluster

with ray_cluster("local"):
    for process in psutil.Process().children(recursive=True):
        for one in process.net_connections("inet"):
            if one.status == psutil.CONN_LISTEN:
                print(one.laddr.ip.removeprefix("::ffff:"))
"""


def test_no_other_machine_reaches_ray_on_this_one() -> None:
    found = subprocess.run([sys.executable, "-c", LISTENING], capture_output=True, text=True, check=True)
    assert set(found.stdout.split()) == {"127.0.0.1"}


@pytest.fixture
def elsewhere(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Address for clients of a cluster that this process is no part of."""
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 64)
    with socket.create_server(("", 0)) as one, socket.create_server(("", 0)) as other:
        port, client_port = one.getsockname()[1], other.getsockname()[1]
    options = [f"--port={port}", f"--ray-client-server-port={client_port}", "--num-cpus=1", "--include-dashboard=false"]
    ray_program = str(Path(sys.executable).with_name("ray"))
    command = [ray_program, "start", "--head", "--block", *options]
    head = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert head.stdout is not None
    for line in head.stdout:  # it tells what to do once it has started
        if "Ray runtime started" in line:
            break
    yield f"ray://127.0.0.1:{client_port}"
    head.terminate()
    head.wait(PATIENCE_S)


@pytest.mark.slow
@pytest.mark.long
def test_a_command_uses_a_cluster_elsewhere(elsewhere: str, tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    record(here, 100, progress=False)
    words = ["record", "--windows", "100", "--executor", "ray", "--address", elsewhere, "--out", str(there)]
    command = [sys.executable, "-c", "import sys; from tint_sumo.cli import main; sys.exit(main())", *words]
    wait_until(lambda: subprocess.run(command, capture_output=True, check=False).returncode == 0)
    assert contents(there) == contents(here)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "ray://127.0.0.1", "nowhere"])
def test_no_cluster_at_an_address(address: str) -> None:
    with pytest.raises(InputError, match=f"^no Ray cluster answers at {address} .*; check `address`$"):
        ray_cluster(address).__enter__()


@pytest.mark.parametrize("missing", ["ENABLE_RAY_CLUSTER", "ENABLE_RAY_CLUSTERS_ENV_VAR"])
def test_a_ray_that_cannot_be_kept_on_this_machine_is_not_started(
    missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(f"ray._private.ray_constants.{missing}")
    monkeypatch.setattr("ray.init", lambda *_, **__: pytest.fail("Ray has started"))
    with pytest.raises(InputError, match=r"^Ray \S+ cannot be kept .*; install ray \S+, or .* give its `address`$"):
        ray_cluster("local").__enter__()


def test_the_object_store_holds_the_last_state_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held: weakref.WeakSet[Content] = weakref.WeakSet()

    def put(content: bytes) -> Content:
        held.add(found := Content(content))
        return found

    monkeypatch.setattr("ray.put", put)
    store, file = _FileStore(), tmp_path / "file"
    for state in range(3):
        file.write_bytes(bytes([state]))
        first = store.put(file, (state, 1))
        assert store.put(file, (state, 1)) is first
        assert first.content == bytes([state])
        del first
        assert len(held) == 1


class Content:
    """Stands for a reference to an object of Ray."""

    def __init__(self, content: bytes) -> None:
        self.content = content


def test_a_share_of_a_gpu() -> None:
    with pytest.raises(InputError, match="gpus_per_job must be 0 or more, not -1"):
        ray_cluster("auto", -1.0).__enter__()


def test_an_evaluation_is_the_same_case_by_case(cluster: Executor) -> None:
    contender, task = load_policy("oracle"), TaskSettings(p_conservative=0.4)
    alone = evaluate(contender.policy, lambda count: contender.make_venv(count, task), 150, 3)
    assert evaluate_on(cluster, "oracle", task, 150, 3, progress=False) == alone


def test_shards_go_to_a_store_from_where_they_are_recorded(cluster: Executor, two_shards: Path, tmp_path: Path) -> None:
    place = (tmp_path / "there").as_uri()
    record(place, TWO_SHARDS, workers=cluster, fcd=True, progress=False)
    assert contents(tmp_path / "there") == contents(two_shards)
    assert (tmp_path / "there" / MANIFEST).read_bytes() == (two_shards / MANIFEST).read_bytes()


def test_a_url_is_given_to_the_command(s3_url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--windows", "100", "--out", s3_url]) == 0
    assert capsys.readouterr().out.rstrip().endswith(f"windows in {s3_url}")
    assert {"manifest.json", "trajectories/shard-00000.parquet"} <= Store(s3_url).files().keys()


def test_ray_is_needed_for_its_executor_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "tint_sumo.jobs.cluster")
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["policy", "evaluate", "--model", "ttc", "--executor", "ray"]) == 2
    assert 'pip install "tint_sumo[ray]"' in capsys.readouterr().err
    assert main(["record", "--out", "x", "--address", "ray://head:10001"]) == 2
    assert "--address goes with --executor ray" in capsys.readouterr().err
    assert main(["record", "--out", "x", "--executor", "ray", "--workers", "4"]) == 2
    assert "--workers goes with --executor local" in capsys.readouterr().err
