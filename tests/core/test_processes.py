"""Worker processes; how they end is tested where they work."""

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import os
import sys
from tint_sumo.core.processes import start_worker

def work(pipe):
    pipe.send(("tint_sumo.core.files" in sys.modules, os.environ.get("WHEN")))

def answer():
    pipe, process = start_worker(work)
    print(*pipe.recv())
    process.join()

if __name__ == "__main__":
    import tint_sumo.core.files
    answer()
    os.environ["WHEN"] = "later"
    answer()
    del os.environ["WHEN"]
    answer()
"""


def test_workers_have_the_modules_and_the_environment_of_the_main_process(tmp_path: Path) -> None:
    script = tmp_path / "main.py"
    script.write_text(SCRIPT)
    result = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines() == ["True None", "True later", "True None"]
    assert not result.stderr
