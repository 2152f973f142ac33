"""The package as users install it."""

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import pytest
import yaml
from packaging.utils import canonicalize_name

import tint_sumo
from tint_sumo.core.files import write_text

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("script", sorted((ROOT / "scripts").glob("*.py")), ids=lambda script: script.stem)
def test_scripts_import_what_is_there(script: Path) -> None:
    for node in ast.walk(ast.parse(script.read_text())):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("tint_sumo"):
            module = importlib.import_module(str(node.module))
            for name in node.names:
                assert hasattr(module, name.name) or importlib.util.find_spec(f"{node.module}.{name.name}"), name.name


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the wheel and the source distribution, made and checked by ``make dist``."""
    folder = tmp_path_factory.mktemp("dist")
    installed = f"{sys.prefix}/.installed"  # whether it is up to date is not the question here
    command = ["make", "dist", f"DIST={folder}", f"VENV={sys.prefix}", f"--old-file={installed}"]
    made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout + made.stderr
    assert made.stdout.count("PASSED") == 2 and ".whl: OK" in made.stdout
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (file,) = dist.glob("*.whl")
    return file


def test_the_wheel_holds_network_models_and_type_marker(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for file in (ROOT / "sumo_net").iterdir():
        assert f"tint_sumo/shipped/sumo_net/{file.name}" in names
    models = ROOT / "data" / "models"
    for file in models.rglob("*.*"):
        assert f"tint_sumo/shipped/models/{file.relative_to(models).as_posix()}" in names
    assert "tint_sumo/py.typed" in names
    assert [name for name in names if name.endswith(".dist-info/licenses/LICENSE")]
    assert not [name for name in names if name.endswith((".pth", ".pyc"))]  # nothing runs when Python starts
    assert wheel.stat().st_size < 8e6


def test_the_source_distribution_holds_what_the_wheel_is_made_of_and_no_more(
    dist: Path, wheel: Path, tmp_path: Path
) -> None:
    (file,) = dist.glob("*.tar.gz")
    assert file.stat().st_size < 8e6
    with tarfile.open(file) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    assert {path.name for path in source.iterdir() if path.is_dir()} == {"tint_sumo", "sumo_net", "data"}
    assert {path.name for path in (source / "data").iterdir()} == {"models"}
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel"]
    subprocess.run(build, cwd=source, capture_output=True, check=True)
    assert (source / "dist" / wheel.name).read_bytes() == wheel.read_bytes()


@dataclass(frozen=True)
class Fresh:
    """A fresh environment with the wheel; the dependencies alone are those of this one."""

    folder: Path

    @property
    def site(self) -> Path:
        (site,) = self.folder.glob("lib/python*/site-packages")
        return site

    def run(self, program: str, *arguments: str, cwd: Path, **variables: str) -> str:
        """Return what a program of the environment prints."""
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | variables
        command = [str(self.folder / "bin" / program), *arguments]
        result = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr
        return result.stdout


@pytest.fixture(scope="module")
def fresh(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Fresh:
    made = Fresh(tmp_path_factory.mktemp("fresh"))
    venv.create(made.folder)
    pip = [sys.executable, "-m", "pip", "--python", str(made.folder / "bin" / "python"), "install", "--quiet"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([*pip, "--no-deps", str(wheel)], env=environment, check=True)
    dependencies = f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})"
    (made.site / "dependencies.pth").write_text(dependencies)
    return made


def test_the_wheel_works_in_a_fresh_environment(fresh: Fresh, tmp_path: Path) -> None:
    code = """
import gymnasium
env = gymnasium.make("tint_sumo:tint_sumo/TIntersection-v1")
env.reset(seed=0)
env.step(2)
import tint_sumo.core.files, tint_sumo.traits
assert (tint_sumo.core.files.shipped("sumo_net") / "tint.net.xml").exists()
print(tint_sumo.__file__, tint_sumo.core.files.shipped("models"), tint_sumo.traits.load("vae").latent_size)
"""
    expected = f"{fresh.site}/tint_sumo/__init__.py {fresh.site}/tint_sumo/shipped/models 2\n"
    assert fresh.run("python", "-c", code, cwd=tmp_path) == expected
    assert not list(tmp_path.iterdir())


def test_pipx_and_uvx_find_the_command_by_the_name_of_the_package(wheel: Path) -> None:
    """Both look for a program with the name that was typed, which the index holds in its normal form."""
    with zipfile.ZipFile(wheel) as archive:
        (points,) = (archive.read(name).decode() for name in archive.namelist() if name.endswith("entry_points.txt"))
    commands = re.findall(r"^(\S+) = ", points, re.MULTILINE)
    assert commands == [canonicalize_name(wheel.name.split("-", maxsplit=1)[0])]


FIRST_TYPED = [
    ("--help",),
    ("--version",),
    ("models",),
    ("models", "cross_window"),
    pytest.param(
        ("policy", "evaluate", "--model", "oracle", "--p-conservative", "0.4", "--episodes", "2"),
        marks=pytest.mark.long,
    ),
]


@pytest.mark.parametrize("arguments", FIRST_TYPED, ids=" ".join)
def test_first_commands_need_no_folder_that_they_may_write_to(
    fresh: Fresh, arguments: tuple[str, ...], tmp_path: Path
) -> None:
    """Even root cannot write to ``/proc``."""
    assert fresh.run("tint-sumo", *arguments, cwd=Path("/proc"), HOME="/proc", TMPDIR=str(tmp_path))
    assert {path.name.split("_")[0] for path in tmp_path.iterdir()} <= {"torchinductor"}  # an empty one of torch


FIRST_WRITTEN = [
    ("net", "--out", "asked"),
    pytest.param(("record", "--out", "asked", "--windows", "100", "--p-conservative", "0.5"), marks=pytest.mark.long),
    pytest.param(
        ("render", "--model", "always_go", "--p-conservative", "0.4", "--case", "0", "--out", "asked/case.png"),
        marks=pytest.mark.long,
    ),
]


@pytest.mark.parametrize("arguments", FIRST_WRITTEN, ids=lambda arguments: arguments[0])
def test_commands_write_what_is_asked_and_nothing_beside_it(
    fresh: Fresh, arguments: tuple[str, ...], tmp_path: Path
) -> None:
    here, home, scratch = (tmp_path / name for name in ("here", "home", "scratch"))
    for folder in (here, home, scratch):
        folder.mkdir()
    fresh.run("tint-sumo", *arguments, cwd=here, HOME=str(home), TMPDIR=str(scratch))
    assert [path.name for path in here.iterdir()] == ["asked"] and any((here / "asked").iterdir())
    assert not list(home.iterdir()) and not list(scratch.iterdir())


def test_the_version_is_the_same_everywhere() -> None:
    """It is written once for Python; other files repeat it."""
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    version = tint_sumo.__version__
    released = re.search(rf"^## \[{re.escape(version)}\] - (\d{{4}}-\d\d-\d\d)$", changes, re.MULTILINE)
    assert released or f"\nThis will be version {version}," in changes
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == version
    assert citation.get("date-released") == (date.fromisoformat(released[1]) if released else None)
    images = [
        image
        for folder in ("examples", "docs")
        for file in (ROOT / folder).rglob("*")
        if file.suffix in {".md", ".yaml", ""} and file.is_file()
        for image in re.findall(r"tint-sumo:(\d[\w.]+\w)", file.read_text(encoding="utf-8"))
    ]
    assert set(images) == {version}


def test_package_citation_and_archive_describe_the_same_work() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    archive = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    assert project["keywords"] == citation["keywords"] == archive["keywords"]
    assert project["license"] == citation["license"] == archive["license"]
    assert citation["title"] == archive["title"] and project["name"] in citation["title"]
    assert [one["name"] for one in citation["authors"]] == [one["name"] for one in archive["creators"]]
    papers = [one["identifier"] for one in archive["related_identifiers"]]
    assert papers == [one["value"] for one in citation["preferred-citation"]["identifiers"]]


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
