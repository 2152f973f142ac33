"""Credentials in URLs reach neither files nor screens."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tint_sumo.cli import main
from tint_sumo.core.redaction import redact
from tint_sumo.core.stores import Store
from tint_sumo.core.training_log import FOLDER, open_log

SECRET = "hush/hush+"
URLS = (
    f"s3://KEY:{SECRET}@bucket/folder",
    f"s3://bucket/folder?access_key=KEY&secret_key={SECRET}",
    f"s3://bucket/folder?region=here&session_token={SECRET}&scheme=http",
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (URLS[0], "s3://bucket/folder"),
        (URLS[1], "s3://bucket/folder"),
        (URLS[2], "s3://bucket/folder?region=here&scheme=http"),
        (f"tint-sumo record --out '{URLS[1]}' --seed 1", "tint-sumo record --out 's3://bucket/folder' --seed 1"),
        ("s3://KEY:p@ss@bucket/a", "s3://bucket/a"),
        ("https://account.blob/c?sv=1&sig=abc%2B", "https://account.blob/c?sv=1"),
        ("s3://bucket/a@b?design=1 and you@example.org?", "s3://bucket/a@b?design=1 and you@example.org?"),
        ("ray://host:10001", "ray://host:10001"),
    ],
)
def test_only_credentials_are_left_out(text: str, expected: str) -> None:
    assert redact(text) == expected


@given(
    key=st.from_regex(r"[A-Z0-9]{4,8}", fullmatch=True), secret=st.from_regex(r"q[a-zA-Z0-9+/]{7,20}", fullmatch=True)
)
def test_no_secret_survives(key: str, secret: str) -> None:
    for url in (
        f"s3://{key}:{secret}@bucket/x",
        f"gs://bucket/x?a=1&secret_key={secret}&b=2",
        f"s3://b?TOKEN={secret}",
    ):
        assert secret not in redact(f"cannot write {url}: refused")


def test_a_run_at_a_url_keeps_no_credentials_and_is_resumed(
    s3_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    url = s3_url.replace("://", f"://KEY:{SECRET.replace('/', '%2F')}@")
    words = ["record", "--out", url, "--windows", "20", "--workers", "2", "--json"]
    assert main(words) == 0
    assert main(words) == 0
    assert main([*words[:4], "50"]) == 2
    assert main(["policy", "evaluate", "--model", url]) == 2
    assert main([*words, "--print-config"]) == 0
    printed = "".join(capfd.readouterr())
    assert printed.count(s3_url) > 3
    files = {path: Store(url).read(path) for path in Store(url).files()}
    assert b"s3://bucket/folder" in files["provenance.json"]
    assert b"out: s3://bucket/folder\n" in files["config.yaml"]
    assert "hush" not in printed
    assert not any(b"hush" in content for content in files.values())


def test_hyperparameters_of_a_log_hold_no_credentials(tmp_path: Path) -> None:
    open_log(tmp_path, {"model": {"from": URLS[1]}}, ["success"]).close()
    events = b"".join(file.read_bytes() for file in (tmp_path / FOLDER).iterdir())
    assert b"s3://bucket/folder" in events
    assert b"hush" not in events
