"""A server on this machine that speaks as S3 does."""

import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_START_LIMIT_S = 60.0


@contextmanager
def s3_server(log: Path) -> Iterator[str]:
    """Run one in a process of its own, on a free port; yields its address."""
    command = [sys.executable, "-m", "moto.server", "--host", "127.0.0.1", "--port", "0"]
    with log.open("wb") as file, subprocess.Popen(command, stdout=file, stderr=file) as process:
        try:
            yield _wait_for_address(log, process)
        finally:
            process.terminate()


def empty_bucket(endpoint: str, bucket: str) -> None:
    """Remove all that the server has, and make a bucket."""
    for method, path in (("POST", "moto-api/reset"), ("PUT", bucket)):
        urllib.request.urlopen(urllib.request.Request(f"{endpoint}/{path}", method=method)).close()


def _wait_for_address(log: Path, process: subprocess.Popen[bytes]) -> str:
    latest = time.monotonic() + _START_LIMIT_S
    while time.monotonic() < latest and process.poll() is None:
        found = re.search(r"http://127\.0\.0\.1:\d+", log.read_text())
        if found:
            return found.group()
        time.sleep(0.05)
    raise RuntimeError(f"the S3 server has not started: {log.read_text()}")
