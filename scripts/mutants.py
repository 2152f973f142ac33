"""Break the code at many places, one at a time, and see which of these mutants the tests kill.

    .venv/bin/python scripts/mutants.py
    .venv/bin/python scripts/mutants.py --modules envs/rows policy/loss --sample 40
    .venv/bin/python scripts/mutants.py --seconds 240
    .venv/bin/python scripts/mutants.py --again

Cosmic Ray makes the mutants and keeps their results in runs/mutants, so that an interrupted call goes on. --seconds
ends a call after some time. A module that has changed begins anew. --again tries the survivors once more, after tests
have been written; until then they stay survivors. Mutants that do the same as the code are in tests/mutants.toml, with
the reason, and do not count.

Works in a copy of the repository, which changes of yours do not reach until the next call. Where a module has compiled
functions, all of them run as Python, so that no mutant has to be compiled. Tests run in processes that are forked off
after all packages are loaded.
"""

import argparse
import ast
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from importlib import import_module
from pathlib import Path

import numba
import pytest
from cosmic_ray.commands import init
from cosmic_ray.mutating import use_mutation
from cosmic_ray.plugins import get_operator
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import TestOutcome, WorkerOutcome, WorkItem, WorkResult

ROOT = Path(__file__).parents[1]
WORK = ROOT / "runs" / "mutants"
EQUIVALENT = ROOT / "tests" / "mutants.toml"
SEED = 0  # of samples
SLOWEST_S = 10.0  # a mutant may take so much longer than the code, and three times as long

TESTS = {  # by the module that is broken
    "simulation/yielding": "tests/simulation/test_yielding.py",
    "simulation/ego": "tests/simulation/test_ego.py",
    "simulation/demand": "tests/simulation/test_demand.py",
    "simulation/slots": "tests/simulation/test_slots.py",
    "simulation/lanes": "tests/simulation/test_lanes.py",
    "scenes/sight": "tests/scenes/test_sight.py",
    "envs/rows": "tests/envs/test_rows.py",
    "envs/sensing": "tests/envs/test_sensing.py",
    "envs/episodes": "tests/envs/test_episodes.py",
    "dataset/windows": "tests/dataset/test_windows.py",
    "traits/vae": "tests/traits/test_vae.py",
    "traits/cross_window": "tests/traits/test_cross_window.py -k 'not uncertainty'",
    "traits/streaming": "tests/traits/test_streaming.py",
    "policy/loss": "tests/policy/test_loss.py",
    "policy/ppo": "tests/policy/test_ppo.py",
    "policy/buffer": "tests/policy/test_buffer.py",
    "methods/evaluation": "tests/methods/test_evaluation.py",
    "core/statistics": "tests/core/test_statistics.py",
}


@dataclass(frozen=True)
class Tally:
    """Counts of the mutants of a module by their outcome."""

    module: str
    mutants: int  # all that there are
    killed: int
    equivalent: int
    survivors: tuple[str, ...]  # what was broken, as text

    @property
    def line(self) -> str:
        tried = self.killed + len(self.survivors)
        share = f"{100 * self.killed / tried:.1f} %" if tried else "-"
        return f"{self.module:24} {self.mutants:7} {tried:7} {self.killed:7} {self.equivalent:11} {share:>8}"


def main(argv: Sequence[str] | None = None) -> int:
    arguments = _parse(argv)
    end_s = time.monotonic() + (arguments.seconds or 1e9)
    os.environ["NUMBA_CACHE_DIR"] = str(WORK / "numba")
    sys.dont_write_bytecode = True  # a mutant may have the size and the time of the code before it
    tree = _copy_tree(WORK / "tree")
    os.chdir(tree)
    sys.path.insert(0, str(tree))
    tallies = [_break_module(name, tree, arguments, end_s) for name in arguments.modules]
    print(f"\n{'module':24} {'mutants':>7} {'tried':>7} {'killed':>7} {'equivalent':>11} {'share':>8}")
    for tally in tallies:
        print(tally.line)
    for tally in tallies:
        print("".join(f"\n{tally.module} survives:\n{survivor}\n" for survivor in tally.survivors), end="")
    return 0


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--modules", nargs="+", choices=TESTS, default=list(TESTS), metavar="MODULE")
    parser.add_argument("--sample", type=int, help="so many mutants of each module, drawn with a fixed seed")
    parser.add_argument("--seconds", type=float, help="begin no mutant after so much time")
    parser.add_argument("--again", action="store_true", help="try the survivors again")
    return parser.parse_args(argv)


def _copy_tree(tree: Path) -> Path:
    """Copy the files that Git knows or would add."""
    shutil.rmtree(tree, ignore_errors=True)
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines():
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)  # Numba knows files by their times
    return tree


def _break_module(name: str, tree: Path, arguments: argparse.Namespace, end_s: float) -> Tally:
    file, tests = tree / "tint_sumo" / f"{name}.py", shlex.split(TESTS[name])
    source = file.read_text(encoding="utf-8")
    session = WORK / f"{name.replace('/', '-')}-{sha256(source.encode()).hexdigest()[:8]}.sqlite"
    with use_db(str(session)) as db:
        if not db.num_work_items:
            init([file], db, {})
        mutants = sorted(_worth_trying(db.work_items, source), key=_order)
        count = min(len(mutants), arguments.sample or len(mutants))
        chosen = random.Random(SEED).sample(mutants, count)
        results = dict(db.results)
        killed = {job for job, result in results.items() if result.test_outcome == TestOutcome.KILLED}
        settled = killed if arguments.again else results.keys()
        waiting = [mutant for mutant in chosen if mutant.job_id not in settled]
        if waiting and time.monotonic() < end_s:
            numba.config.DISABLE_JIT = "@compiled" in source  # type: ignore[attr-defined]
            limit_s = SLOWEST_S + 3.0 * _prepare(tests)
            for number, item in enumerate(waiting):
                if time.monotonic() > end_s:
                    break
                results[item.job_id] = _try(db, item, file, tests, limit_s)
                print(f"\r{name}: {number + 1} of {len(waiting)} mutants", end="", file=sys.stderr, flush=True)
            print(file=sys.stderr)
    return _tally(name, len(mutants), [results[mutant.job_id] for mutant in chosen if mutant.job_id in results])


def _prepare(tests: Sequence[str]) -> float:
    """Run the tests on the code as it is, load the packages that they load, and return how long that took, s.

    Nothing of tint_sumo is loaded here: forked processes load that themselves, and with it the mutant.
    """
    began_s, loaded = time.monotonic(), WORK / "loaded.txt"
    assert _run_tests(tests, 600.0, loaded) == TestOutcome.SURVIVED, f"{tests} fail without any mutant"
    for name in loaded.read_text(encoding="utf-8").split():
        if name.split(".")[0] not in ("tint_sumo", "tests", "conftest", "__main__"):
            with suppress(Exception):
                import_module(name)
    return time.monotonic() - began_s


def _order(item: WorkItem) -> tuple[str, int]:
    (mutation,) = item.mutations
    return mutation.operator_name, mutation.occurrence


def _worth_trying(items: Sequence[WorkItem], source: str) -> Iterator[WorkItem]:
    """Leave out what changes types alone, or removes the marks of functions that are compiled or timed."""
    spans = [
        ((node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0))
        for node in _annotations(ast.parse(source))
    ]
    lines = source.splitlines()
    for item in items:
        (mutation,) = item.mutations
        marks = lines[mutation.start_pos[0] - 1].strip().startswith(("@compiled", "@does"))
        if not marks and not any(start <= mutation.start_pos < end for start, end in spans):
            yield item


def _annotations(module: ast.Module) -> Iterator[ast.expr]:
    for node in ast.walk(module):
        if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None:
            yield node.annotation
        elif isinstance(node, ast.FunctionDef) and node.returns is not None:
            yield node.returns


def _try(db: WorkDB, item: WorkItem, file: Path, tests: Sequence[str], limit_s: float) -> WorkResult:
    (mutation,) = item.mutations
    operator = get_operator(mutation.operator_name)(**mutation.operator_args)
    # The item also has a path, which is that of another copy if the folder of the results has been moved.
    with use_mutation(file, operator, mutation.occurrence) as (was, now):
        assert now is not None
        outcome = _run_tests(tests, limit_s)
    result = WorkResult(WorkerOutcome.NORMAL, test_outcome=outcome, diff=_changed(was, now))
    db.set_result(item.job_id, result)
    return result


def _changed(was: str, now: str) -> str:
    """Return the lines that differ, before and after."""
    before, after = was.splitlines(), now.splitlines()
    first = next(number for number, pair in enumerate(zip(before, after, strict=False)) if pair[0] != pair[1])
    tail = 0
    while before[-1 - tail] == after[-1 - tail] and tail < min(len(before), len(after)) - first - 1:
        tail += 1
    parts = (lines[first : len(lines) - tail] for lines in (before, after))
    return "\n".join(f"{sign} {' '.join(' '.join(part).split())}" for sign, part in zip("-+", parts, strict=True))


def _run_tests(tests: Sequence[str], limit_s: float, loaded: Path | None = None) -> TestOutcome:
    """Run tests in a forked process, until the first one fails; ``loaded``: write there which modules it has loaded."""
    process = os.fork()
    if process == 0:
        os.setsid()
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(nowhere.fileno(), 2)
        status = pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow and not long", *tests])
        if loaded is not None:
            loaded.write_text("\n".join(sys.modules), encoding="utf-8")
        os._exit(int(status))
    with _limit(limit_s):
        try:
            _, status = os.waitpid(process, 0)
        except TimeoutError:
            status = 1
        finally:
            _kill_group(process)
    return TestOutcome.SURVIVED if status == 0 else TestOutcome.KILLED


@contextmanager
def _limit(limit_s: float) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _kill_group(process: int) -> None:
    """End a forked process and all that it has started."""
    with suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)
    with suppress(ChildProcessError):
        os.waitpid(process, 0)


def _tally(name: str, mutants: int, results: Sequence[WorkResult]) -> Tally:
    listed = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))["equivalent"]
    same = {f"- {known['was']}\n+ {known['now']}" for known in listed if known["module"] == name}
    outcomes = Counter(result.test_outcome for result in results)
    survived = [result.diff or "" for result in results if result.test_outcome == TestOutcome.SURVIVED]
    survivors = tuple(survivor for survivor in survived if survivor not in same)
    return Tally(name, mutants, outcomes[TestOutcome.KILLED], len(survived) - len(survivors), survivors)


if __name__ == "__main__":
    sys.exit(main())
