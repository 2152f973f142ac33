"""The ``tint-sumo`` command: the tree of commands, and how a command line is parsed and run."""

import io
import json
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, OmitSubcommandPrefixes, arg, subcommand

from tint_sumo.cli.bench import Bench
from tint_sumo.cli.command import Command, flag_of
from tint_sumo.cli.configuration import commands_named, config_of, read_command, write_command
from tint_sumo.cli.dataset import Dataset, Record
from tint_sumo.cli.drivers import Drivers
from tint_sumo.cli.models import Models
from tint_sumo.cli.net import Net
from tint_sumo.cli.policy import Policy
from tint_sumo.cli.render import Render
from tint_sumo.cli.scene import Scene
from tint_sumo.cli.study import Study
from tint_sumo.cli.tracks import Tracks
from tint_sumo.cli.traits import Traits
from tint_sumo.core.errors import BAD_PATHS, InputError, JobError, system_problem
from tint_sumo.core.files import at_home
from tint_sumo.core.processes import end_quickly, interrupt_on_sigterm
from tint_sumo.core.provenance import Origin, made_by, version_text
from tint_sumo.core.ranges import require_ranges
from tint_sumo.core.redaction import redact
from tint_sumo.core.streams import READER_GONE, flushed_output, has_lost_reader, open_closed_streams, show_any_name

Shell = Literal["bash", "zsh", "tcsh"]
_COMPLETION = arg(
    help="Print a script that completes commands and flags in that shell, and do nothing else. For bash, put this line "
    'into ~/.bashrc: eval "$(tint-sumo --print-completion bash)".'
)
_ONE_SLASH = re.compile(r"[a-z][a-z0-9]*:/(?!/)")  # a mistyped URL
_TYRO = (OmitArgPrefixes, OmitSubcommandPrefixes, FlagCreatePairsOff)


@dataclass(frozen=True, kw_only=True)
class TintSumo:
    """Driving among strangers: driver-trait inference and intersection navigation on Eclipse SUMO."""

    version: bool = False
    """Print the version, and those of SUMO, torch, gymnasium and Python, and do nothing else."""
    print_completion: Annotated[Shell | None, _COMPLETION] = None

    command: (
        Annotated[Net, subcommand("net")]
        | Annotated[Scene, subcommand("scene")]
        | Annotated[Record, subcommand("record")]
        | Annotated[Dataset, subcommand("dataset")]
        | Annotated[Tracks, subcommand("tracks")]
        | Annotated[Drivers, subcommand("drivers")]
        | Annotated[Traits, subcommand("traits")]
        | Annotated[Policy, subcommand("policy")]
        | Annotated[Study, subcommand("study")]
        | Annotated[Render, subcommand("render")]
        | Annotated[Bench, subcommand("bench")]
        | Annotated[Models, subcommand("models")]
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    It is 0; 1 if jobs failed or the system refused something, such as room on a full disk; 2 after bad input; 130 after
    Ctrl-C or SIGTERM; or 141 if nobody reads any more what it prints.
    """
    end_quickly()
    interrupt_on_sigterm()
    open_closed_streams()
    show_any_name()
    try:
        with flushed_output():
            return _run(list(sys.argv[1:] if argv is None else argv))
    except OSError as error:
        if has_lost_reader():
            return READER_GONE
        return _refuse(system_problem(error), 2 if isinstance(error, BAD_PATHS) else 1)
    except UnicodeEncodeError as error:
        return _refuse(f"a name holds {error.object[error.start]!r}, which is no text; use another name", 1)


def _run(words: list[str]) -> int:
    """Run the command of a command line, and print its outcome."""
    if words[:1] == ["--print-completion"] and words[1:2] in ([shell] for shell in get_args(Shell)):
        print(_completion_script(words[1]), end="")
        return 0
    if words[:1] == ["--version"]:
        print(version_text())
        return 0
    command = Command()
    try:
        command = parse(words)
        if command.print_config:
            print(write_command(command), end="")
            return 0
        with made_by(Origin(tuple(words), partial(write_command, command))):
            outcome = command.run()
    except (InputError, JobError) as error:
        return _refuse(command.with_flags(str(error)), 2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt:
        print("\ntint-sumo: interrupted; all files are whole" + command.after_interrupt, file=sys.stderr)
        return 130
    print(redact(outcome.text))
    if command.json:
        print(redact(_json_text(outcome.content)))
    return 0


def _json_text(content: Mapping[str, Any]) -> str:
    """Return JSON with null for numbers that are not finite, which JSON does not know."""
    from pydantic_core import to_jsonable_python

    return json.dumps(to_jsonable_python(content, inf_nan_mode="null"), allow_nan=False)


def _refuse(message: str, exit_code: int) -> int:
    print(f"tint-sumo: error: {redact(message)}", file=sys.stderr)
    return exit_code


def parse(words: list[str]) -> Command:
    """Return the command of a command line, with the values of its configuration file.

    Raises:
        InputError: the file is not there, a value in it does not fit, a flag comes twice, or a path is a URL.
    """
    words = _with_build(words)
    _require_each_once(words)
    file = config_of(words)
    *groups, kind = commands_named(TintSumo, words)
    if file is None or not issubclass(kind, Command):
        parsed: Any = tyro.cli(TintSumo, prog="tint-sumo", args=words, config=_TYRO)
    else:
        default: Any = read_command(kind, file)
        for group in reversed(groups):
            default = group(command=default)
        with_pairs = [mark for mark in _TYRO if mark is not FlagCreatePairsOff]  # --no-json for json: true
        parsed = tyro.cli(TintSumo, prog="tint-sumo", args=words, default=default, config=with_pairs)
    while not isinstance(parsed, Command):
        parsed = parsed.command
    command = _at_home(parsed)
    _require_paths(command)
    require_ranges(command)
    return command


def _with_build(words: list[str]) -> list[str]:
    """Return the words with ``net build`` in place of ``net`` alone."""
    if words[:1] == ["net"] and words[1:2] and words[1].startswith("-") and words[1] not in ("-h", "--help"):
        return ["net", "build", *words[1:]]
    return ["net", "build"] if words == ["net"] else words


def _require_each_once(words: Sequence[str]) -> None:
    """Raise InputError if a flag comes twice: the values behind the first would be ignored in silence."""
    flags = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")]  # tyro takes both
    for flag in flags:
        if flags.count(flag) > 1:
            raise InputError(f"{flag} is given twice; give it once, with all of its values behind it")


def _at_home(command: Command) -> Command:
    """Return the command with the user's home folder for a leading ``~/`` of its paths, which a shell may have left."""
    values = {field.name: getattr(command, field.name) for field in fields(command)}
    paths: dict[str, Any] = {
        name: type(value)(at_home(str(value))) for name, value in values.items() if isinstance(value, str | Path)
    }
    return replace(command, **paths)


def _require_paths(command: Command) -> None:
    """Raise InputError if a URL is given where a path belongs: it would become a folder with a strange name."""
    for name, value in vars(command).items():
        if isinstance(value, str) and _ONE_SLASH.match(value):
            raise InputError(
                f"{flag_of(name)} is neither a folder nor a URL; give two slashes, as in s3://bucket/folder"
            )
        if isinstance(value, Path) and value.parts and value.parts[0].endswith(":"):
            raise InputError(
                f"{flag_of(name)} of this command is a path on this machine, not a URL; only record, traits "
                "study, study run and policy sweep write to URLs"
            )


def _completion_script(shell: str) -> str:
    """Return a script for a shell that completes commands and flags, and does not need this package."""
    script = io.StringIO()
    with redirect_stdout(script), suppress(SystemExit):
        tyro.cli(TintSumo, prog="tint-sumo", args=["--tyro-print-completion", shell], config=_TYRO)
    # The script would offer each line of a help text as a word.
    lines = script.getvalue().splitlines(keepends=True)
    return "".join(line.replace("\\n", " ") if line.startswith("COMPLETION_SPEC") else line for line in lines)
