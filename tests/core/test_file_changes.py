"""Changes of the files in a folder, and their way to another folder."""

import os
from pathlib import Path

import pytest

from tint_sumo.core.file_changes import Changes, read_files, write_files

NOW_S = 1_000_000.0  # the present time of these tests


def put(file: Path, content: str, age_s: float) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content)
    os.utime(file, (NOW_S - age_s, NOW_S - age_s))


def test_what_has_changed_is_taken_once_and_older_files_come_first(tmp_path: Path) -> None:
    put(tmp_path / "old.txt", "old", 100)
    changes = Changes(tmp_path)
    assert changes.take() == {}
    put(tmp_path / "a_done.json", "done", 10)
    put(tmp_path / "deep" / "er" / "b.txt", "first", 30)
    put(tmp_path / "old.txt", "newer", 20)
    assert list(changes.take().items()) == [
        ("deep/er/b.txt", b"first"),
        ("old.txt", b"newer"),
        ("a_done.json", b"done"),
    ]
    assert changes.take() == {}


def test_other_content_of_the_same_size_is_a_change(tmp_path: Path) -> None:
    put(tmp_path / "a", "one", 20)
    changes = Changes(tmp_path)
    put(tmp_path / "a", "two", 10)
    assert changes.take() == {"a": b"two"}


def test_a_folder_may_come_later(tmp_path: Path) -> None:
    changes = Changes(tmp_path / "run")
    assert changes.take() == {}
    put(tmp_path / "run" / "a", "a", 10)
    assert changes.take() == {"a": b"a"}


def test_while_somebody_writes_only_what_is_settled_is_taken(tmp_path: Path) -> None:
    changes = Changes(tmp_path)
    put(tmp_path / "settled", "1", 1.1)
    put(tmp_path / "fresh", "2", 0.9)
    assert changes.take(NOW_S) == {"settled": b"1"}
    assert changes.take(NOW_S + 1) == {"fresh": b"2"}
    put(tmp_path / "fresh", "3", 0.0)
    assert changes.take(NOW_S) == {}
    assert changes.take() == {"fresh": b"3"}


def test_a_file_that_is_replaced_after_the_look_waits(tmp_path: Path) -> None:
    """Its new content may follow a file that this look has not seen."""
    changes = Changes(tmp_path)
    put(tmp_path / "a", "a", 20)
    put(tmp_path / "index", "old", 10)
    taking = changes.take_each(NOW_S)
    assert next(taking) == ("a", b"a")
    put(tmp_path / "index", "new", 0.5)
    assert list(taking) == []
    assert changes.take() == {"index": b"new"}


def test_vanished_files(tmp_path: Path) -> None:
    for name in ("known", "dir/known"):
        put(tmp_path / name, name, 10)
    changes = Changes(tmp_path)
    put(tmp_path / "new", "new", 5)
    (tmp_path / "known").unlink()
    assert list(changes.take(NOW_S).items()) == [("new", b"new"), ("known", None)]
    (tmp_path / "dir" / "known").unlink()
    (tmp_path / "dir").rmdir()
    (tmp_path / "new").unlink()
    put(tmp_path / "never taken", "", 5)
    (tmp_path / "never taken").unlink()
    assert changes.take(NOW_S) == {"dir/known": None, "new": None}
    assert changes.take(NOW_S) == {}
    put(tmp_path / "known", "known", 10)  # the very file again
    assert changes.take(NOW_S) == {"known": b"known"}


def test_a_file_is_not_removed_before_the_one_that_replaces_it_is_there(tmp_path: Path) -> None:
    put(tmp_path / "checkpoint", "half way", 10)
    changes = Changes(tmp_path)
    put(tmp_path / "model", "done", 0.5)
    (tmp_path / "checkpoint").unlink()
    assert changes.take(NOW_S) == {}
    assert list(changes.take(NOW_S + 1).items()) == [("model", b"done"), ("checkpoint", None)]


def test_a_file_that_could_not_be_sent_is_taken_again(tmp_path: Path) -> None:
    changes = Changes(tmp_path)
    for age_s, name in ((30, "sent"), (20, "failing"), (10, "next")):
        put(tmp_path / name, name, age_s)
    for path, _ in changes.take_each():
        if path == "failing":
            break
    assert list(changes.take()) == ["failing", "next"]


def test_temporary_files_and_locks_do_not_count(tmp_path: Path) -> None:
    changes = Changes(tmp_path)
    for name in (".lock", "deep/.lock", ".a.123.partial", "a.lock"):
        put(tmp_path / name, "", 10)
    assert list(changes.take()) == list(read_files(tmp_path, [""])) == ["a.lock"]


def test_only_the_files_and_folders_that_were_asked_for_count(tmp_path: Path) -> None:
    changes = Changes(tmp_path, ("log.csv", "deep", "absent"))
    for name in ("log.csv", "log.csv2", "deep/a", "deep/er/b", "other/c"):
        put(tmp_path / name, name, 10)
    assert set(changes.take()) == set(read_files(tmp_path, ["log.csv", "deep"])) == {"log.csv", "deep/a", "deep/er/b"}


def test_files_get_to_another_folder(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    for name in ("a b#c?.txt", "deep/b.bin"):
        put(here / name, name, 10)
    changes = Changes(here)
    write_files(there, read_files(here, [""]))
    assert read_files(there, [""]) == {"a b#c?.txt": b"a b#c?.txt", "deep/b.bin": b"deep/b.bin"}
    (here / "deep" / "b.bin").unlink()
    put(here / "a b#c?.txt", "changed", 5)
    write_files(there, changes.take())
    write_files(there, {"was never there": None})
    assert read_files(there, [""]) == {"a b#c?.txt": b"changed"}


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_files(tmp_path, {"a": b"old"})

    def write_half(file: Path, content: bytes) -> None:
        file.open("wb").write(content[: len(content) // 2])
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", write_half)
    with pytest.raises(OSError, match="disk full"):
        write_files(tmp_path, {"a": b"new"})
    monkeypatch.undo()
    assert read_files(tmp_path, [""]) == {"a": b"old"}
    assert [file.name for file in tmp_path.iterdir()] == ["a"]
