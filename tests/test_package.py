"""The package as users install it."""

import ast
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import tint_sumo
from tint_sumo.core.files import write_text

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(folder), str(ROOT)], check=True)
    return next(folder.glob("*.whl"))


def test_the_wheel_holds_network_models_and_type_marker(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for file in (ROOT / "sumo_net").iterdir():
        assert f"tint_sumo/shipped/sumo_net/{file.name}" in names
    models = ROOT / "data" / "models"
    for file in models.rglob("*.*"):
        assert f"tint_sumo/shipped/models/{file.relative_to(models).as_posix()}" in names
    assert "tint_sumo/py.typed" in names
    assert not [name for name in names if name.endswith(".pth")]  # nothing runs when Python starts


def test_the_wheel_works_in_a_fresh_environment(wheel: Path, tmp_path: Path) -> None:
    """Started in an empty folder; the dependencies alone are those of this environment."""
    fresh, empty = tmp_path / "fresh", tmp_path / "empty"
    empty.mkdir()
    venv.create(fresh)
    python = fresh / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([*pip, str(wheel)], env=environment, check=True)
    (site,) = fresh.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})")
    code = """
import gymnasium
env = gymnasium.make("tint_sumo:tint_sumo/TIntersection-v1")
env.reset(seed=0)
env.step(2)
import tint_sumo.core.files, tint_sumo.traits
assert (tint_sumo.core.files.shipped("sumo_net") / "tint.net.xml").exists()
print(tint_sumo.__file__, tint_sumo.core.files.shipped("models"), tint_sumo.traits.load("vae").latent_size)
"""
    for command, expected in (
        ([str(fresh / "bin" / "tint-sumo"), "--help"], "usage: tint-sumo"),
        ([str(python), "-c", code], f"{site}/tint_sumo/__init__.py {site}/tint_sumo/shipped/models 2"),
    ):
        result = subprocess.run(command, cwd=empty, env=environment, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr
        assert result.stdout.startswith(expected)
    assert not list(empty.iterdir())


def test_the_version_is_the_same_everywhere() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    version = tint_sumo.__version__
    assert f"\nversion: {version}\n" in citation
    assert f"\n## [{version}] - 2" in changes or f"\nThis will be version {version}" in changes


def test_pre_commit_runs_the_linters_of_the_makefile() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (lint,) = re.findall(r"^lint: install\n((?:\t.+\n)+)", makefile, re.MULTILINE)
    hooks = re.findall(r"^ +entry: (.+)$", (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"), re.MULTILINE)
    assert hooks == [line.strip().replace("$(BIN)", ".venv/bin") for line in lint.splitlines()]


def test_importing_the_package_loads_no_more_than_gymnasium() -> None:
    code = "import sys, tint_sumo; print(*sorted(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"torch", "libsumo", "pandas", "sklearn", "matplotlib"} & set(loaded)


def floors() -> list[list[str]]:
    """Modules and packages of each floor, the lowest first, as import-linter checks them."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = settings["tool"]["importlinter"]["contracts"]
    return [re.split(r"\s*[|:]\s*", layer) for layer in reversed(contract["layers"])]


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Check the package in a folder by the contract of this one."""
    code = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    command = [sys.executable, "-c", code, "--no-cache", "--config", str(ROOT / "pyproject.toml")]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_packages_import_downwards_only() -> None:
    found = lint_imports(ROOT)
    assert found.returncode == 0, found.stdout + found.stderr


@pytest.mark.parametrize(
    ("importer", "line", "is_broken"),
    [
        ("scenes/some.py", "import tint_sumo.study.summary", True),
        ("scenes/some.py", "from tint_sumo.study.summary import __file__", True),
        ("scenes/some.py", "from tint_sumo import study", True),
        ("core/some.py", "from tint_sumo import config", True),
        ("policy/ppo.py", "def late() -> None:\n    from tint_sumo import study", True),
        ("envs/rows.py", "from tint_sumo import dataset", True),
        ("bench/measuring.py", "from tint_sumo import films", True),
        ("unknown.py", "", True),
        ("config/some.py", "from tint_sumo import core, jobs", False),
        ("study/some.py", "from tint_sumo import scenes", False),
    ],
)
def test_imports_that_go_up_are_found_however_they_are_written(
    tmp_path: Path, importer: str, line: str, is_broken: bool
) -> None:
    empty = [".", *(name for names in floors() for name in names), "study/summary"]
    files = {f"{name}/__init__.py": "" for name in empty} | {importer: line}
    for file, text in files.items():
        write_text(tmp_path / "tint_sumo" / file, text)
    found = lint_imports(tmp_path)
    assert found.returncode == int(is_broken), found.stdout + found.stderr
    assert ("BROKEN" in found.stdout or "unknown" in found.stdout) == is_broken


def test_contributing_tells_the_floors_that_are_checked() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| (\d+) \| (.+?) \|", text, re.MULTILINE)
    written = {int(floor): set(re.findall(r"`tint_sumo/(\w+)(?:\.py|/)`", places)) for floor, places in table}
    assert written == {number: set(names) for number, names in enumerate(floors())}


def test_compiled_functions_use_nothing_of_other_files() -> None:
    """Machine code is renewed when its own file changes, not when a constant or function of another one does."""
    checked = 0
    for file in (ROOT / "tint_sumo").rglob("*.py"):
        module = ast.parse(file.read_text(encoding="utf-8"))
        ours = {
            alias.asname or alias.name
            for node in module.body
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tint_sumo")
            for alias in node.names
        }
        for function in module.body:
            if isinstance(function, ast.FunctionDef) and "compiled" in map(ast.unparse, function.decorator_list):
                used = {node.id for part in function.body for node in ast.walk(part) if isinstance(node, ast.Name)}
                assert not used & ours, f"{file}: {function.name} uses {used & ours}"
                checked += 1
    assert checked > 5
