"""Completion of commands and flags, in a real bash."""

import shutil
import subprocess
import sys

import pytest

from tint_sumo.cli import main

SHELLS = ("bash", "zsh", "tcsh")


@pytest.fixture(scope="module")
def script() -> str:
    """Return the script that a fresh process prints for bash."""
    command = [sys.executable, "-m", "tint_sumo.cli", "--print-completion", "bash"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def completions(script: str, *words: str) -> list[str]:
    """Return the words that bash offers for the last one when TAB is pressed."""
    lines = [
        script,
        f"COMP_WORDS=({' '.join(map(repr, words))})",
        f"COMP_CWORD={len(words) - 1}",
        "$(complete -p tint-sumo | sed 's/.*-F \\([^ ]*\\) .*/\\1/') tint-sumo",
        'printf "%s\\n" "${COMPREPLY[@]}"',
    ]
    run = subprocess.run(["bash", "--norc", "-s"], input="\n".join(lines), capture_output=True, text=True, check=True)
    assert run.stderr == ""
    return run.stdout.split("\n")[:-1]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["tint-sumo", "pol"], ["policy"]),
        (["tint-sumo", "policy", "tr"], ["train"]),
        (["tint-sumo", "policy", "train", "--bud"], ["--budget"]),
        (["tint-sumo", "policy", "train", "--other"], ["--other-scene"]),
        (["tint-sumo", "policy", "train", "--tra"], ["--traits"]),  # its help has two lines
        (["tint-sumo", "policy", "train", "--budget", ""], ["quick", "full", "strangers", "paper"]),
        (["tint-sumo", "record", "--config", "x.yaml", "--wi"], ["--windows"]),
        (["tint-sumo", "--pr"], ["--print-completion"]),
    ],
)
def test_bash_completes(words: list[str], offered: list[str], script: str) -> None:
    assert completions(script, *words) == offered


def test_the_script_is_printed_without_what_commands_need() -> None:
    code = (
        "import sys, tint_sumo.cli\n"
        "assert tint_sumo.cli.main(['--print-completion', 'bash']) == 0\n"
        "print([name for name in ('torch', 'pandas', 'libsumo', 'sumolib', 'sklearn') if name in sys.modules])"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.splitlines()[-1] == "[]"


@pytest.mark.parametrize("shell", SHELLS)
def test_there_is_a_script_for_each_shell(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--print-completion", shell]) == 0
    script = capsys.readouterr().out
    assert "tint-sumo" in script
    assert main(["--print-completion", shell, "models"]) == 0
    assert capsys.readouterr().out == script


def test_help_tells_of_it_and_other_shells_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "--print-completion" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        main(["--print-completion", "dos"])
    assert stop.value.code == 2
    assert "dos" in capsys.readouterr().err
