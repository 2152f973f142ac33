"""Folders at URLs: on a server that speaks as S3 does, and on this machine."""

import os
import pickle
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.waiting import wait_until
from tint_sumo.core import file_changes, stores
from tint_sumo.core.errors import InputError, JobError
from tint_sumo.core.file_changes import Changes
from tint_sumo.core.files import claim_folder
from tint_sumo.core.stores import Store, is_url, name_in, working_folder


@pytest.fixture(params=["s3", "file"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(request.getfixturevalue("s3_url")) if request.param == "s3" else f"file://{tmp_path}/store"


@pytest.fixture
def file_url(tmp_path: Path) -> str:
    return f"file://{tmp_path}/store"


@pytest.mark.parametrize(
    ("out", "expected"),
    [("s3://b/x", True), ("file:///x", True), ("x/y", False), ("s3:/b", False), (Path("/x"), False)],
)
def test_what_is_a_url(out: str | Path, expected: bool) -> None:
    assert is_url(out) is expected


@pytest.mark.parametrize(
    ("out", "name"),
    [
        ("r/", "r/a/b.csv"),
        ("./", "a/b.csv"),
        ("e", "e/a/b.csv"),
        (Path("/x"), "/x/a/b.csv"),
        ("s3://bucket/x/", "s3://bucket/x/a/b.csv"),
        ("s3://KEY:SECRET@bucket?region=here", "s3://bucket/a/b.csv?region=here"),
    ],
)
def test_files_are_called_by_the_name_that_the_user_knows(out: str | Path, name: str) -> None:
    assert name_in(out, Path("a/b.csv")) == name


def test_files_come_and_go(url: str) -> None:
    store = Store(url)
    assert store.files() == {}
    store.write("a.txt", b"one")
    store.write("deep/er/b.bin", b"\0" * 5)
    store.write("a.txt", b"other")
    store.write("empty", b"")
    assert store.files() == {"a.txt": 5, "deep/er/b.bin": 5, "empty": 0}
    assert store.files("deep") == {"deep/er/b.bin": 5}
    assert store.files("absent") == {}
    assert store.read("a.txt") == b"other"
    assert store.read("empty") == b""
    assert [store.exists(path) for path in ("a.txt", "deep", "b", "deep/er/b.bin")] == [True, False, False, True]
    for _ in range(2):
        store.delete("a.txt")
    store.delete("absent/file")
    assert store.files() == {"deep/er/b.bin": 5, "empty": 0}
    with pytest.raises(InputError, match=r"cannot read .*: it has no file a\.txt; "):
        store.read("a.txt")


def test_another_process_may_be_given_a_store(url: str) -> None:
    store = Store(url)
    store.write("a", b"a")
    data = pickle.dumps(store)
    assert len(data) < 100 + len(url)  # neither connections nor credentials
    assert pickle.loads(data).read("a") == b"a"


@pytest.mark.parametrize("end", ["", "/", "/with space#é", "/with%20space/"])
def test_special_characters(url: str, end: str) -> None:
    path = "a b/c#d?e%20f+é.txt"
    Store(url + end).write(path, b"x")
    assert Store(url + end).files() == {path: 1}
    assert Store(url + end).read(path) == b"x"
    folder = end.strip("/").replace("%20", " ")
    assert Store(url).files() == {f"{folder}/{path}".lstrip("/"): 1}


def test_a_whole_bucket(s3_url: str) -> None:
    Store(s3_url).write("a", b"a")
    assert Store("s3://bucket").files() == Store("s3://bucket/").files() == {"folder/a": 1}


def test_the_server_may_be_named_in_the_url(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = os.environ["AWS_ENDPOINT_URL"].removeprefix("http://")
    monkeypatch.delenv("AWS_ENDPOINT_URL")
    store = Store(f"{s3_url}?endpoint_override={endpoint}&scheme=http")
    store.write("deep/a", b"a")
    assert store.files() == {"deep/a": 1}


def test_temporary_files_and_locks_are_not_listed(url: str) -> None:
    for path in (".a.123.partial", "deep/.lock", "lock"):
        Store(url).write(path, b"")
    assert list(Store(url).files()) == ["lock"]


def test_keys_that_lead_out_of_a_folder_are_not_listed(s3_url: str, s3_endpoint: str) -> None:
    with socket.create_connection(s3_endpoint.removeprefix("http://").split(":")) as connection:  # type: ignore[arg-type]
        connection.sendall(b"PUT /bucket/folder/../../evil HTTP/1.0\r\nHost: 127.0.0.1\r\nContent-Length: 1\r\n\r\nx")
        assert b" 200 " in connection.recv(1000)
    assert Store("s3://bucket").files() == {}


def run_killed(code: str, arguments: list[str], environment: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
    head = "import os, signal, sys\nfrom tint_sumo.core.stores import Store\nstore = Store(sys.argv[1])\n"
    return subprocess.Popen([sys.executable, "-c", head + code, *arguments], env=os.environ | (environment or {}))


def test_a_killed_write_leaves_the_old_content_on_this_machine(file_url: str, tmp_path: Path) -> None:
    Store(file_url).write("a", b"old")
    code = """
class KilledBeforeMoving:
    def __getattr__(self, name):
        return getattr(real, name)
    def move(self, source, target):
        os.kill(os.getpid(), signal.SIGKILL)

real, path = store._home
store.__dict__["_home"] = KilledBeforeMoving(), path
store.write("a", b"new")
"""
    with run_killed(code, [file_url]) as process:
        assert process.wait() == -signal.SIGKILL
    assert len(list((tmp_path / "store").glob(".a.*.partial"))) == 1
    assert Store(file_url).files() == {"a": 3}
    assert Store(file_url).read("a") == b"old"


def stalling_proxy(endpoint: str, limit: int, stalled: threading.Event) -> Iterator[str]:
    """Address of a way to the server that brings it no more than so many bytes of all that is asked."""
    host, port = endpoint.removeprefix("http://").split(":")
    left, copying = [limit], list[threading.Thread]()

    def copy(source: socket.socket, target: socket.socket, counted: bool) -> None:
        with suppress(OSError):
            while content := source.recv(65536):
                if counted:
                    left[0] -= len(content)
                if left[0] < 0:
                    stalled.set()
                else:
                    target.sendall(content)
        with suppress(OSError):
            target.shutdown(socket.SHUT_WR)

    def serve() -> None:
        with suppress(OSError):
            while True:
                here, _ = listener.accept()
                there = socket.create_connection((host, int(port)))
                for arguments in ((here, there, True), (there, here, False)):
                    copying.append(threading.Thread(target=copy, args=arguments, daemon=True))
                    copying[-1].start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, daemon=True).start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)
    for thread in copying:
        thread.join(30.0)
        assert not thread.is_alive(), "the server still waits for the rest"


@pytest.mark.parametrize("size", [2_000_000, 30_000_000])  # in one request, and in parts
def test_a_killed_write_leaves_the_old_content_on_a_server(s3_url: str, s3_endpoint: str, size: int) -> None:
    Store(s3_url).write("a", b"old")
    stalled = threading.Event()
    for proxy in stalling_proxy(s3_endpoint, size // 2, stalled):
        code = f"store.write('a', b'x' * {size})"
        with run_killed(code, [s3_url], {"AWS_ENDPOINT_URL": proxy}) as process:
            assert stalled.wait(30.0)
            process.kill()
    assert Store(s3_url).files() == {"a": 3}
    assert Store(s3_url).read("a") == b"old"


def test_ctrl_c_leaves_no_file_that_is_cut_short(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It comes where Arrow has opened the file and not been given its content."""
    real = stores._put

    def put_slowly(filesystem: object, path: str, content: bytes) -> None:
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.2)
        real(filesystem, path, content)

    monkeypatch.setattr(stores, "_put", put_slowly)
    with pytest.raises(KeyboardInterrupt):
        Store(s3_url).write("a", b"whole")
    assert Store(s3_url).read("a") == b"whole"


def test_a_path_stands_for_itself(tmp_path: Path) -> None:
    with working_folder(tmp_path / "run") as folder:
        assert folder == tmp_path / "run"
    with working_folder("run") as folder:
        assert folder == Path("run")


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("file:///DISK/runs/paper", "paper"),
        ("file:///DISK/runs/paper%20two/", "paper two"),
        ("file:///DISK/runs/.hidden", "hidden"),
        (f"file:///DISK/{'long' * 50}", "long" * 15),
    ],
)
def test_a_working_folder_is_called_as_the_folder_at_the_url(url: str, name: str, tmp_path: Path) -> None:
    with working_folder(url.replace("/DISK", str(tmp_path))) as folder:
        assert folder.name == name  # the name of a study, in the title of its report


def test_a_working_folder_begins_with_the_files_of_the_store_and_leaves_them_there(url: str) -> None:
    with working_folder(url) as folder:
        assert list(folder.iterdir()) == []
        (folder / "deep").mkdir()
        (folder / "deep" / "a b.txt").write_text("a")
        (folder / "b").write_text("b")
        for name in (".lock", ".b.1.partial"):
            (folder / name).touch()
    assert not folder.exists()
    assert Store(url).files() == {"b": 1, "deep/a b.txt": 1}
    with working_folder(url) as folder:
        assert (folder / "deep" / "a b.txt").read_text() == "a"
        (folder / "b").write_text("bb")
        (folder / "deep" / "a b.txt").unlink()
    assert Store(url).files() == {"b": 2}


@pytest.mark.parametrize("error", [ValueError, InputError, KeyboardInterrupt])
def test_what_is_there_is_sent_when_the_block_fails(file_url: str, error: type[BaseException]) -> None:
    with pytest.raises(error, match=r"^failed$"), working_folder(file_url) as folder:
        (folder / "a").write_text("a")
        raise error("failed")
    assert Store(file_url).files() == {"a": 1}
    assert not folder.exists()


def test_a_run_at_a_url_is_resumed_and_another_one_refused(url: str) -> None:
    with working_folder(url) as folder, claim_folder(folder, {"seed": 1}):
        (folder / "half").write_text("half")
    with working_folder(url) as folder, claim_folder(folder, {"seed": 1}):
        assert (folder / "half").read_text() == "half"
    message = f"^{re.escape(url)} already holds another run"
    with pytest.raises(InputError, match=message), working_folder(url) as folder, claim_folder(folder, {"seed": 2}):
        pytest.fail("the block must not begin")
    assert set(Store(url).files()) == {"half", "run.json"}


@pytest.mark.parametrize("kind", [InputError, JobError])
def test_errors_name_files_as_the_user_knows_them(kind: type[Exception], tmp_path: Path) -> None:
    url = f"file://{tmp_path}/store"
    with (
        pytest.raises(kind, match=f"^{url}: {url}/a/b.csv is damaged, see {url}/c; {tmp_path}$"),
        working_folder(url) as at,
    ):
        raise kind(f"{at}: {at}/a/b.csv is damaged, see {at}/c; {tmp_path}")


def test_files_are_sent_while_the_block_runs(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "PUSH_INTERVAL_S", 0.05)
    monkeypatch.setattr(file_changes, "SETTLED_S", 3600.0)
    store = Store(url)
    store.write("checkpoint", b"half way")
    with working_folder(url) as folder:
        (folder / "model").write_text("done")
        (folder / "checkpoint").unlink()
        time.sleep(0.5)
        assert store.files() == {"checkpoint": 8}  # nothing has settled
        monkeypatch.setattr(file_changes, "SETTLED_S", 0.0)
        wait_until(lambda: store.files() == {"model": 4})


def test_a_file_is_never_there_without_those_that_were_written_before_it(
    file_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "PUSH_INTERVAL_S", 0.01)
    monkeypatch.setattr(file_changes, "SETTLED_S", 0.2)
    written: list[str] = []
    real = Store.write
    monkeypatch.setattr(
        Store, "write", lambda self, path, content: (written.append(path), real(self, path, content))[0]
    )
    ordered = []
    with working_folder(file_url) as folder:
        for number in range(100):
            ordered.append(f"{(number * 37) % 100}")
            (folder / ordered[-1]).write_text("x")
            time.sleep(0.015)  # the clock of file systems is coarse
            if number == 50:
                wait_until(lambda: bool(written))
                monkeypatch.setattr(file_changes, "SETTLED_S", 3600.0)  # what comes now is sent at the end
        sent_in_the_block = len(written)
    assert 0 < sent_in_the_block < 100
    assert written == ordered


def test_a_store_that_fails_for_a_while_gets_everything(file_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "PUSH_INTERVAL_S", 0.05)
    real, failed = Store.write, threading.Event()

    def fail_once(self: Store, path: str, content: bytes) -> None:
        if path == "b" and not failed.is_set():
            failed.set()
            raise InputError("no connection")
        real(self, path, content)

    monkeypatch.setattr(Store, "write", fail_once)
    with working_folder(file_url) as folder:
        for name in "abc":
            (folder / name).write_text(name)
        assert failed.wait(30.0)
        wait_until(lambda: len(Store(file_url).files()) == 3)


def test_what_cannot_be_sent_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(stores, "PUSH_INTERVAL_S", 0.05)
    (tmp_path / "store").write_text("a file where the folder should be")
    real_files = Store.files
    monkeypatch.setattr(Store, "files", lambda self: {})
    message = r"cannot write file://.*everything is kept in .*_not_sent$"
    with pytest.raises(InputError, match=message) as raised, working_folder(f"file://{tmp_path}/store") as folder:
        (folder / "a").write_text("result")
        time.sleep(1.5)  # it fails while the block runs, too
    kept = Path(str(raised.value).split(" is kept in ")[1])
    assert (kept / "a").read_text() == "result"
    assert {entry.name for entry in tmp_path.iterdir()} == {"store", kept.name}
    monkeypatch.setattr(Store, "files", real_files)
    with pytest.raises(InputError, match="Not a directory"), working_folder(f"file://{tmp_path}/store"):
        pass


def test_nothing_is_removed_from_the_store_when_the_folder_goes(file_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C may end the wait for a thread that is sending files."""
    monkeypatch.setattr(stores, "PUSH_INTERVAL_S", 0.05)
    real, looking, gone, looked = Changes.take_each, threading.Event(), threading.Event(), threading.Event()

    def take_late(self: Changes, before_s: float | None = None) -> Iterator[tuple[str, bytes | None]]:
        looking.set()
        gone.wait(30.0)
        yield from real(self, before_s)
        looked.set()

    Store(file_url).write("old", b"old")
    monkeypatch.setattr(Changes, "take_each", take_late)
    previous = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), working_folder(file_url) as folder:
            assert looking.wait(30.0)
            signal.setitimer(signal.ITIMER_REAL, 0.2)
    finally:
        signal.signal(signal.SIGALRM, previous)
    assert not folder.exists()
    gone.set()
    looked.wait(1.0)
    assert Store(file_url).files() == {"old": 3}


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("nowhere://a/b", r"cannot read nowhere://a/b: Unrecognized filesystem type .*; use a URL such as s3://"),
        ("s3:///folder", r"cannot read s3:///folder: Missing bucket name"),
        ("s3://bucket/a?color=red", r"cannot read .*: Unexpected query parameter in S3 URI: 'color'; "),
        ("s3://missing/a", r"cannot read s3://missing/a: there is no bucket 'missing'; make it first"),
        ("s3://me:secret@missing/a", r"cannot read s3://missing/a: "),
        ("file:///proc/1/mem", r"cannot read file:///proc/1/mem: .*; choose a folder that you may write to"),
    ],
)
def test_errors_are_one_line(s3_url: str, url: str, message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}") as raised, working_folder(url):
        pytest.fail("the block must not begin")
    assert "\n" not in str(raised.value)
    assert "secret@" not in str(raised.value)


def test_writing_to_a_bucket_that_is_not_there_is_refused(s3_url: str, s3_endpoint: str) -> None:
    with pytest.raises(InputError, match=r"^cannot write s3://missing/a: .*does not exist.*; check the bucket"):
        Store("s3://missing/a").write("b", b"")
    with pytest.raises(InputError, match="there is no bucket"):  # nor has that made it
        Store("s3://missing/a").files()


def test_a_server_that_does_not_answer_is_told_of_within_seconds(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # nobody listens
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{unused.getsockname()[1]}")
        start_s = time.monotonic()
        with pytest.raises(InputError, match=r"^cannot read s3://bucket/folder: .*connect.*AWS_ENDPOINT_URL[^\n]*$"):
            Store(s3_url).files()
    assert time.monotonic() - start_s < 30.0


def test_the_command_line_does_not_load_arrow_for_it() -> None:
    code = "import sys, tint_sumo.core.stores; sys.exit('pyarrow' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
