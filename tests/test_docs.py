"""The README and the documentation: their commands and code work, their names exist, and the site is whole."""

import os
import re
import subprocess
import sys
from pathlib import Path
from pydoc import locate

import pytest

from tests.commands import commands
from tests.documents import blocks
from tests.study.browser import FLAGS, require_browser

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = ROOT / "docs"
FIRST_READ = [README, DOCS / "getting-started.md", DOCS / "reference" / "environments.md"]
READ_LATER = [*sorted(DOCS.glob("tutorials/*.md")), *sorted(DOCS.glob("how-to/*.md"))]
TYPED = [*FIRST_READ, *READ_LATER]
NAMING = [README, ROOT / "CONTRIBUTING.md", ROOT / "data" / "README.md", *sorted(DOCS.rglob("*.md"))]
_NAME = re.compile(r"\btint_sumo(?:\.[A-Za-z_]\w*)+")
_PATH = re.compile(r"`((?:tint_sumo|tests|scripts|docs|examples|data|sumo_net)/[\w./*-]*)`")
_FETCHED = re.compile(r"<(?:script|img|link rel=.stylesheet.)[^>]+(?:src|href)=.(https?://[^\"']+)")


@pytest.mark.parametrize(
    "page",
    [
        *(pytest.param(page, id=page.stem, marks=pytest.mark.slow) for page in FIRST_READ),
        *(pytest.param(page, id=page.stem, marks=pytest.mark.long) for page in READ_LATER),
    ],
)
def test_commands_and_code_on_a_page_work(page: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.documents", str(page)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_pages_that_are_run_have_something_to_run() -> None:
    with_blocks = [page for page in TYPED if any(block.language != "text" for block in blocks(page))]
    assert len(with_blocks) > 12
    assert set(DOCS.glob("tutorials/*.md")) <= set(with_blocks)


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ("```bash\nexit 3\n```\n", "exit code 3"),
        ("```python\nprint('one')\n```\n\n```text\ntwo\n```\n", "what came out is"),
        ("```python\n1 / 0\n```\n", "ZeroDivisionError"),
    ],
)
def test_a_page_that_does_not_work_is_found(block: str, message: str, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(block)
    command = [sys.executable, "-m", "tests.documents", str(page)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert message in result.stderr


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as ``make docs`` builds it: a warning is an error."""
    folder = tmp_path_factory.mktemp("docs") / "site"
    beside_python = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = os.environ | {"PATH": beside_python, "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return folder


def test_the_site_has_all_pages_and_needs_no_network(site: Path) -> None:
    pages = {page.relative_to(DOCS).with_suffix(".html") for page in DOCS.rglob("*.md")}
    assert all((site / page).exists() for page in pages)
    assert "--p-conservative" in (site / "reference" / "commands.html").read_text(encoding="utf-8")
    assert not [url for page in site.rglob("*.html") for url in _FETCHED.findall(page.read_text())]


def test_the_site_is_searched_and_read_from_a_folder(site: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason='needs: pip install "tint_sumo[dev]"')
    troubles: list[str] = []
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=require_browser(), args=list(FLAGS))
        page = browser.new_page()
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on(
            "request", lambda one: None if one.url.startswith(("file:", "data:", "blob:")) else troubles.append(one)
        )
        page.goto((site / "index.html").as_uri())
        page.click(".md-search__input")
        page.keyboard.type("headway")
        page.wait_for_selector(".md-search-result__link")
        assert "Differences from the paper" in str(page.text_content(".md-search-result__list"))
        page.click(".md-search-result__link >> nth=0")
        page.wait_for_url("file://**/explanation/*.html*")
        browser.close()
    assert troubles == []


def test_every_command_is_in_the_reference() -> None:
    reference = (DOCS / "reference" / "commands.md").read_text(encoding="utf-8")
    shown = re.findall(r"^COLUMNS=100 (tint-sumo .*) --help$", reference, re.MULTILINE)
    assert sorted(shown) == sorted(f"tint-sumo {name}" for name, _ in commands())
    assert re.findall(r"^## (tint-sumo .*)$", reference, re.MULTILINE) == shown


@pytest.mark.parametrize("page", NAMING, ids=lambda page: str(page.relative_to(ROOT)))
def test_names_in_a_page_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert [name for name in set(_NAME.findall(text)) if locate(name) is None] == []
    paths = [
        path for path in set(_PATH.findall(text)) if path == path.lower()
    ]  # others hold a placeholder or a version
    assert [path for path in paths if not list(ROOT.glob(path.rstrip("/")))] == []


def test_names_in_docstrings_exist() -> None:
    texts = [file.read_text(encoding="utf-8") for file in (ROOT / "tint_sumo").rglob("*.py")]
    names = {name for text in texts for name in re.findall(rf"``({_NAME.pattern})``", text)}
    assert names
    assert [name for name in names if locate(name) is None] == []


def test_the_readme_is_short() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert len(text.split()) <= 1000
