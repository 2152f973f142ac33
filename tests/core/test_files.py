import json
import subprocess
import sys
from pathlib import Path

import pytest

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import claim_folder, read_json, whole_file, write_json


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


def claim(folder: Path, settings: dict[str, object]) -> None:
    with claim_folder(folder, settings):
        pass


def test_a_folder_belongs_to_one_run(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    claim(folder, {"seed": 1, "sizes": (1, 2)})
    claim(folder, {"seed": 1, "sizes": (1, 2)})
    with pytest.raises(InputError, match=r"already holds another run \(different: seed\)"):
        claim(folder, {"seed": 2, "sizes": (1, 2)})
    assert json.loads((folder / "run.json").read_text()) == {"seed": 1, "sizes": [1, 2]}


def test_a_folder_with_other_files_or_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "letter").write_text("dear")
    with pytest.raises(InputError, match="already holds other files"):
        claim(tmp_path, {"seed": 1})
    with pytest.raises(InputError, match="is a file, not a folder"):
        claim(tmp_path / "letter", {"seed": 1})
    assert [file.name for file in tmp_path.iterdir()] == ["letter"]


def test_one_process_at_a_time_works_in_a_folder_even_if_the_other_one_is_killed(tmp_path: Path) -> None:
    call = f"with claim_folder(Path(r'{tmp_path}'), {{'seed': 1}}):\n    print('claimed', flush=True)\n    input()"
    script = f"from pathlib import Path\nfrom tint_sumo.core.files import claim_folder\n{call}"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", script], **pipes) as process:  # type: ignore[call-overload]
        assert process.stdout.readline() == b"claimed\n"
        half = tmp_path / f".a.{process.pid}.partial"
        half.write_text("half")
        with pytest.raises(InputError, match="another process is working in"):
            claim(tmp_path, {"seed": 1})
        assert half.exists()
        process.kill()
    with claim_folder(tmp_path, {"seed": 1}):
        assert not half.exists()


def test_leftovers_of_a_killed_run_do_not_stand_in_the_way(tmp_path: Path) -> None:
    (tmp_path / ".run.json.123.partial").write_text("half")
    half_folder = tmp_path / ".exported.123.partial"
    half_folder.mkdir()
    (half_folder / ".policy.json.123.partial").write_text("half")
    claim(tmp_path, {"seed": 1})
    assert read_json(tmp_path / "run.json", "run") == {"seed": 1}
    assert not list(tmp_path.glob(".*.partial"))
