import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tint_sumo.errors import InputError
from tint_sumo.files import claim_folder, read_json, remove_leftovers, whole_file, write_json


def test_a_file_is_whole_or_absent(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "result.txt"

    def half_written() -> None:
        with whole_file(file) as partial:
            partial.write_text("half")
            assert not file.exists() or file.read_text() == "whole"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half_written()
    assert list(file.parent.iterdir()) == []
    with whole_file(file) as partial:
        partial.write_text("whole")
    assert file.read_text() == "whole"
    with pytest.raises(KeyboardInterrupt):
        half_written()
    assert file.read_text() == "whole"


def test_json_round_trip(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"x": [1, 2.5, None]})
    assert read_json(tmp_path / "a.json", "thing") == {"x": [1, 2.5, None]}


@pytest.mark.parametrize("text", ["", "{", "[1]", "\x00\xff"])
def test_damaged_json(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=r"thing: .*a\.json is damaged"):
        read_json(tmp_path / "a.json", "thing")


def test_missing_json(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"thing: no file .*a\.json; check the path"):
        read_json(tmp_path / "a.json", "thing")


def test_a_folder_belongs_to_one_run(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    claim_folder(folder, {"seed": 1, "sizes": (1, 2)})
    claim_folder(folder, {"seed": 1, "sizes": (1, 2)})
    with pytest.raises(InputError, match=r"already holds another run \(different: seed\)"):
        claim_folder(folder, {"seed": 2, "sizes": (1, 2)})
    assert json.loads((folder / "run.json").read_text()) == {"seed": 1, "sizes": [1, 2]}


def test_a_folder_with_other_files_or_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "letter").write_text("dear")
    with pytest.raises(InputError, match="already holds other files"):
        claim_folder(tmp_path, {"seed": 1})
    with pytest.raises(InputError, match="is a file, not a folder"):
        claim_folder(tmp_path / "letter", {"seed": 1})
    assert [file.name for file in tmp_path.iterdir()] == ["letter"]


def test_leftovers_go_when_their_process_is_gone(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", "pass"]) as process:
        process.wait()
    gone, running = (tmp_path / f".a.{pid}.partial" for pid in (process.pid, os.getpid()))
    for file in (gone, running):
        file.write_text("half")
    remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [running]


def test_leftovers_of_a_killed_run_do_not_stand_in_the_way(tmp_path: Path) -> None:
    (tmp_path / ".run.json.123.partial").write_text("half")
    claim_folder(tmp_path, {"seed": 1})
    assert read_json(tmp_path / "run.json", "run") == {"seed": 1}
