"""Ctrl-C reaches what tests start, wherever the tests themselves were started."""

import signal
import subprocess
import sys

KILLED_BY_ITSELF = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"


def test_what_a_test_starts_can_be_interrupted() -> None:
    found = subprocess.run([sys.executable, "-c", KILLED_BY_ITSELF], capture_output=True, text=True, check=False)
    assert "KeyboardInterrupt" in found.stderr


def test_so_it_can_where_tests_run_in_the_background() -> None:
    name = f"{__file__}::{test_what_a_test_starts_can_be_interrupted.__name__}"
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        background = subprocess.Popen([sys.executable, "-m", "pytest", name], stdout=subprocess.DEVNULL)
    finally:
        signal.signal(signal.SIGINT, before)
    assert background.wait(120.0) == 0
