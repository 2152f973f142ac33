"""The Dockerfile, as far as it can be tried without Docker: its steps for the package run here, apt's does not."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import venv
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tint_sumo.cli.command_line import parse

ROOT = Path(__file__).parents[1]
SMALL = """
out: small
budget:
  base: quick
  methods: [always_go, ttc]
  seeds: [0]
  trials:
  - {conditions: [{p_conservative: 0.4}], episodes: 20}
"""
Step = tuple[str, str]  # the instruction and its arguments


def stages() -> list[list[Step]]:
    """Return the steps of each stage, its FROM first."""
    text = re.sub(r"^#.*\n", "", (ROOT / "Dockerfile").read_text(encoding="utf-8"), flags=re.MULTILINE)
    steps = [line.split(maxsplit=1) for line in text.replace("\\\n", "").splitlines() if line.strip()]
    found: list[list[Step]] = []
    for instruction, arguments in steps:
        if instruction == "FROM":
            found.append([])
        found[-1].append((instruction, arguments.strip()))
    return found


def arguments_of(stage: list[Step], instruction: str) -> list[str]:
    return [arguments for name, arguments in stage if name == instruction]


def test_the_image_is_built_in_two_stages_and_runs_as_nobody_special() -> None:
    build, image = stages()
    assert arguments_of(build, "FROM")[0].endswith(" AS build")
    assert arguments_of(image, "FROM")[0].endswith("-slim")
    assert not arguments_of(image, "COPY")  # the source stays behind
    names = [name for name, _ in image]
    assert names.index("USER") > max(number for number, name in enumerate(names) if name == "RUN")
    (user,) = arguments_of(image, "USER")
    assert f"useradd --uid {user} " in arguments_of(image, "RUN")[-1] and user != "0"
    assert arguments_of(image, "WORKDIR") == arguments_of(image, "VOLUME") == ["/results"]
    assert all(
        "--no-cache-dir" in run for stage in (build, image) for run in arguments_of(stage, "RUN") if "pip" in run
    )


def test_docker_is_sent_what_is_copied_and_no_more() -> None:
    build, _ = stages()
    copied = {part for arguments in arguments_of(build, "COPY") for part in arguments.split()[:-1]}
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert "*" in lines
    assert {line.removeprefix("!") for line in lines if line.startswith("!")} == copied
    assert all((ROOT / part).exists() for part in copied)


@dataclass
class Image:
    """Folders that stand for the file systems of the stages, and an environment that stands for their Python."""

    root: Path
    variables: dict[str, str] = field(default_factory=dict)

    def run(self, command: str, folder: str = "/") -> str:
        for path in ("/source", "/dist", "/results", "/requirements.txt"):
            command = re.sub(rf"(?<![\w.])({path})\b", f"{self.root}\\1", command)
        where = self.root / folder.strip("/")
        bash = ["bash", "-c", command]
        result = subprocess.run(bash, cwd=where, env=self.variables, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr
        return result.stdout


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Image:
    """Build the image's folders by the steps for the package. Libraries, torch too, are those of this environment."""
    root = tmp_path_factory.mktemp("image")
    venv.create(root / "python")
    pip = root / "python" / "bin" / "pip"
    pip.write_text(f'#!/bin/sh\nexec {sys.executable} -m pip --python {pip.parent}/python "$@"\n')
    pip.chmod(0o755)
    (site,) = (root / "python").glob("lib/python*/site-packages")
    (site / "libraries.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})")
    made = Image(root)
    made.variables = {
        "PATH": f"{root}/python/bin:{os.environ['PATH']}",
        "HOME": str(root),
        "PIP_NO_INDEX": "1",  # whatever a step installs is here already
        "PIP_NO_BUILD_ISOLATION": "0",  # the backend, too
    }
    (root / "source").mkdir()
    (root / "results").mkdir()
    build, final = stages()
    for name, arguments in build:
        if name == "COPY":
            for part in arguments.split()[:-1]:
                copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
                (root / "source" / part).parent.mkdir(parents=True, exist_ok=True)
                copy(ROOT / part, root / "source" / part)
        elif name == "RUN":
            made.run(arguments, folder="source")
    shutil.copy(root / "source" / "requirements.txt", root)
    for arguments in arguments_of(final, "RUN"):
        if "/requirements.txt" in arguments or "/dist" in arguments:
            made.run(re.sub(r"--mount=\S+", "", arguments))
    return made


def call(arguments: str) -> str:
    """Return the command line of ``docker run`` with arguments, or with the image's default."""
    _, final = stages()
    (entry,), (default,) = arguments_of(final, "ENTRYPOINT"), arguments_of(final, "CMD")
    return shlex.join([*json.loads(entry), *(shlex.split(arguments) or json.loads(default))])


@pytest.mark.long
def test_the_image_without_apt_and_torch_is_built_and_has_the_command(image: Image) -> None:
    program = image.root / "python" / "bin" / "tint-sumo"
    assert image.run("command -v tint-sumo") == f"{program}\n"
    assert image.run(call(""), folder="results").startswith("usage: tint-sumo")


@pytest.mark.long
def test_the_command_of_the_image_runs_a_study_into_its_volume(image: Image) -> None:
    (image.root / "results" / "small.yaml").write_text(SMALL)
    image.run(call("study run --config small.yaml"), folder="results")
    assert (image.root / "results" / "small" / "report.html").exists()


@pytest.mark.parametrize("page", ["Dockerfile", "docs/getting-started.md"])
def test_commands_for_the_image_are_understood(page: str) -> None:
    lines = re.findall(r"docker run (?:--\S+ (?:\"\S+\" )?)+tint-sumo (.+)$", (ROOT / page).read_text(), re.MULTILINE)
    assert lines
    for line in lines:
        assert parse(shlex.split(line))
