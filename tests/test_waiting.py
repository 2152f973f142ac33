import subprocess
import threading

from tests.waiting import is_alive, wait_until


def test_a_process_may_end_while_one_looks_at_it() -> None:
    for _ in range(30):
        process = subprocess.Popen(["sleep", "0.02"])
        reaper = threading.Thread(target=process.wait)
        reaper.start()
        assert is_alive(process.pid)
        while is_alive(process.pid):
            pass
        reaper.join()
        assert not is_alive(process.pid)


def test_a_zombie_has_ended() -> None:
    process = subprocess.Popen(["true"])
    wait_until(lambda: not is_alive(process.pid))
    assert process.returncode is None
    process.wait()
