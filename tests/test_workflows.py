"""The workflows of GitHub, as far as they can be checked by reading them, and the versions of the documentation."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tint_sumo.cli.command_line import parse

ROOT = Path(__file__).parents[1]
GITHUB = ROOT / ".github"
ACTION = GITHUB / "actions" / "environment" / "action.yml"
WORKFLOWS = sorted((GITHUB / "workflows").glob("*.yml"))
MACHINES_HAVE = {"gh", "git", "sudo", "test", "tint-sumo", "pip", "cut"}  # tint-sumo after the wheel is installed


def read(file: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(file.read_text(encoding="utf-8"))
    return found


def jobs() -> Iterator[tuple[str, dict[str, Any]]]:
    for file in WORKFLOWS:
        for name, job in read(file)["jobs"].items():
            yield f"{file.stem}/{name}", job


def steps() -> Iterator[dict[str, Any]]:
    yield from read(ACTION)["runs"]["steps"]
    for _, job in jobs():
        yield from job.get("steps", [])


def lines() -> list[str]:
    return [line for step in steps() for line in step.get("run", "").splitlines()]


@pytest.mark.parametrize(
    ("schema", "files"),
    [
        ("github-workflows", WORKFLOWS),
        ("github-actions", [ACTION]),
        ("dependabot", [GITHUB / "dependabot.yml"]),
        ("github-issue-forms", sorted((GITHUB / "ISSUE_TEMPLATE").glob("*.yml"))),
        ("citation-file-format", [ROOT / "CITATION.cff"]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_files_for_github_are_of_their_schemas(schema: str, files: list[Path]) -> None:
    check = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", f"vendor.{schema}"]
    checked = subprocess.run([*check, *map(str, files)], capture_output=True, text=True, check=False)
    assert files and checked.returncode == 0, checked.stdout


def test_actions_of_others_are_pinned_and_ours_exist() -> None:
    texts = "".join(file.read_text(encoding="utf-8") for file in (ACTION, *WORKFLOWS))
    used = re.findall(r"uses: (.+)", texts)
    ours = [one for one in used if one.startswith("./")]
    assert ours and all((ROOT / one).exists() for one in ours)
    theirs = set(used) - set(ours)
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}  # v\d+\.\d+\.\d+", one) for one in theirs), theirs
    assert len({one.split("@")[0] for one in theirs}) == len(theirs)  # the same version everywhere


def test_workflows_run_commands_and_targets_that_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (targets,) = re.findall(r"^\.PHONY: (.+)$", makefile, re.MULTILINE)
    ran = set()
    for line in lines():
        inner = re.findall(r"\$\((.+?)\)", line)
        for command in re.split(r"&&|\|", re.sub(r"\$\(.+?\)", "X", line) + "".join(f"&& {one}" for one in inner)):
            program, *arguments = shlex.split(command)
            if program == "make":
                target, *settings = arguments
                assert target in targets.split()
                assert all(f"$({setting.split('=')[0]})" in makefile for setting in settings)
                ran.add(target)
            elif program == "tint-sumo":
                assert arguments == ["--version"] or parse(arguments)
            elif program.startswith(".venv/bin/"):
                assert shutil.which(Path(program).name, path=str(Path(sys.executable).parent)), program
            else:
                assert program in MACHINES_HAVE, program
    assert ran == {"install", "test", "test-long", "dist", "docs-version"}


def test_a_virtual_screen_is_installed_where_the_machines_have_none() -> None:
    """They have Google Chrome."""
    wanted = set(re.findall(r"missing\+=\((\w+)\)", (ROOT / ".ci" / "run").read_text(encoding="utf-8")))
    (installed,) = re.findall(r"apt-get .*install (?:--\S+ )+([\w ]+)$", "\n".join(lines()), re.MULTILINE)
    assert wanted - {"chromium"} == set(installed.split())


def test_every_supported_python_is_tested() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    supported = re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    matrices = {name: job["strategy"]["matrix"]["python"] for name, job in jobs() if "strategy" in job}
    assert matrices["tests/suite"] == supported
    assert matrices["release/try"][: len(supported)] == supported


def test_only_the_jobs_that_publish_may_write_and_no_password_is_kept() -> None:
    rights = {file.stem: read(file)["permissions"] for file in WORKFLOWS}
    assert rights == {
        "documentation": {"contents": "write"},
        "release": {"contents": "read"},
        "tests": {"contents": "read"},
    }
    found = {name: job["permissions"] for name, job in jobs() if "permissions" in job}
    assert found == {"release/pypi": {"id-token": "write"}, "release/github": {"contents": "write"}}
    pypi = dict(jobs())["release/pypi"]
    assert pypi["environment"]["name"] == "pypi" and pypi["needs"] == ["tests", "try"]
    assert pypi["steps"][-1]["with"] == {"attestations": True}
    texts = "".join(file.read_text(encoding="utf-8") for file in (ACTION, *WORKFLOWS))
    assert "secrets." not in texts
    urls = re.findall(r"https?://(.+)", texts)
    assert urls and all(re.match(r"pypi\.org/|\$\{\{ github\.\w+ \}\}\.github\.io/", url) for url in urls)


@pytest.mark.long
def test_versions_of_the_documentation_live_beside_each_other(tmp_path: Path) -> None:
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", "--shared", str(ROOT), str(clone)], check=True)
    shutil.copy(ROOT / "mkdocs.yml", clone)
    shutil.copy(ROOT / "Makefile", clone)
    who = {f"GIT_{who}_{what}": "somebody@example.org" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    make = ["make", f"VENV={sys.prefix}", f"--old-file={sys.prefix}/.installed", "docs-version"]
    for names in ("0.1 latest", "dev"):
        command = [*make, f"NAMES={names}"]
        site = os.environ | who | {"SITE_URL": "https://example.org/tint_sumo/"}
        made = subprocess.run(command, cwd=clone, env=site, capture_output=True, text=True, check=False)
        assert made.returncode == 0, made.stderr
    git = ["git", "-C", str(clone)]
    tree = [*git, "ls-tree", "-r", "--name-only", "gh-pages"]
    pages = subprocess.run(tree, capture_output=True, text=True, check=True).stdout.splitlines()
    assert {"versions.json", "latest", "0.1/getting-started/index.html", "dev/index.html"} <= set(pages)
    page = subprocess.run([*git, "show", "gh-pages:dev/index.html"], capture_output=True, text=True, check=True).stdout
    assert '"provider": "mike"' in page and "https://example.org/tint_sumo/dev/" in page
