"""The README and the documentation: what they tell their readers to type works, and their tables are the results'."""

import os
import re
import subprocess
import sys
from datetime import date
from pathlib import Path

import pandas
import pytest

from tests.commands import commands
from tests.documents import blocks
from tests.study.browser import FLAGS, require_browser
from tint_sumo.core.percentages import percent
from tint_sumo.envs.rows import OUTCOMES
from tint_sumo.study.results_csv import read_csv
from tint_sumo.study.summary import at_mixes, by_title, over_all_mixes

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
RESULTS = ROOT / "data" / "results"
DOCS = ROOT / "docs"
FIRST_READ = [README, DOCS / "getting-started.md", DOCS / "reference" / "environments.md"]
READ_LATER = [*sorted(DOCS.glob("tutorials/*.md")), *sorted(DOCS.glob("how-to/*.md"))]
TYPED = [*FIRST_READ, *READ_LATER]
_FETCHED = re.compile(r"<(?:script|img|link rel=.stylesheet.)[^>]+(?:src|href)=.(https?://[^\"']+)")
_TABLE = re.compile(r"(?:^\|.*\|\n)+", re.MULTILINE)


@pytest.mark.parametrize(
    "page",
    [
        *(pytest.param(page, id=page.stem, marks=pytest.mark.slow) for page in FIRST_READ),
        *(pytest.param(page, id=page.stem, marks=pytest.mark.long) for page in READ_LATER),
    ],
)
def test_what_a_page_tells_to_type_works(page: Path, tmp_path: Path) -> None:
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
        assert "Where it differs from the paper" in str(page.text_content(".md-search-result__list"))
        page.click(".md-search-result__link >> nth=0")
        page.wait_for_url("file://**/explanation/*.html*")
        browser.close()
    assert troubles == []


def test_every_command_is_in_the_reference() -> None:
    reference = (DOCS / "reference" / "commands.md").read_text(encoding="utf-8")
    shown = re.findall(r"^COLUMNS=100 (tint-sumo .*) --help$", reference, re.MULTILINE)
    assert sorted(shown) == sorted(f"tint-sumo {name}" for name, _ in commands())
    assert re.findall(r"^## (tint-sumo .*)$", reference, re.MULTILINE) == shown


def test_the_readme_is_short() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert len(text.split()) <= 1000


@pytest.mark.parametrize(
    ("page", "head"),
    [
        (README, "| method | seeds | P 0.1"),
        (DOCS / "results" / "index.md", "| method | seeds | P 0.1"),
        (DOCS / "explanation" / "when-traits-help.md", "| method | as trained |"),
    ],
    ids=("README", "results", "when-traits-help"),
)
def test_tables_are_those_of_the_results(page: Path, head: str) -> None:
    measured = _tables(RESULTS / "navigation.md")
    shown = [table for table in _tables(page) if table.startswith(head)]
    assert len(shown) == 1
    assert shown[0] in measured


def test_the_tables_of_the_study_say_what_the_csv_file_says() -> None:
    rows, ceilings = read_csv(RESULTS / "navigation.csv")
    text = re.sub(r" +", " ", (RESULTS / "navigation.md").read_text(encoding="utf-8"))
    for row in at_mixes(rows):
        rates = [re.escape(percent(row.rate(outcome))) + r" \[[^]]+\]" for outcome in OUTCOMES]
        line = " \\| ".join([f"{row.conditions.p_conservative:g}", re.escape(row.title), *rates])
        assert re.search(rf"^\| {line} \|", text, re.MULTILINE), line
    for title, own in by_title(over_all_mixes(rows)).items():
        cells = [f"{percent(row.rate('success'))} ({percent(row.rate('collision'))})" for row in own]
        (line,) = [line for line in text.split("## ")[-1].splitlines() if line.startswith(f"| {title} |")]
        assert [cell for cell in line.strip("| ").split(" | ")[1:] if cell != "-"] == cells
    assert f"| ceiling | | {' | '.join(percent(share) for share in ceilings.values())} |" in text


def test_the_yield_rule_s_page_has_the_study_s_rates() -> None:
    rows, _ = read_csv(RESULTS / "navigation.csv")
    own = {row.conditions.p_conservative: row for row in at_mixes(rows) if row.method == "always_go"}
    cells = [" / ".join(percent(own[p].rate(outcome)) for outcome in OUTCOMES) for p in (0.25, 0.4, 0.6)]
    assert f"| `TIntersection-v1` | {' | '.join(cells)} |" in (DOCS / "explanation" / "yield-rule.md").read_text()


def test_differences_that_are_told_are_those_of_the_study() -> None:
    text = (RESULTS / "navigation.md").read_text(encoding="utf-8")
    told = re.findall(r"\+[\d.]+ \[[^]]+\]", (DOCS / "explanation" / "when-traits-help.md").read_text(encoding="utf-8"))
    assert len(told) == 2
    for method, difference in zip(("cross-window", "oracle"), told, strict=True):
        (line,) = [line for line in text.splitlines() if re.match(rf"\| {method} +\| no labels ", line)]
        assert difference == line.split("|")[4].strip()


def test_the_table_of_trait_models_has_the_study_s_accuracies() -> None:
    table = pandas.read_csv(RESULTS / "traits.csv").set_index(["method", "noise_m"])
    head, _, *lines = next(
        one for one in _tables(DOCS / "explanation" / "trait-models.md") if "| noise |" in one
    ).split("\n")[:-1]
    methods = re.findall("`(.*?)`", head)
    assert len(methods) == 4 and len(lines) == 4
    for line in lines:
        noise, *cells = line.strip("| ").split(" | ")
        for method, cell in zip(methods, cells, strict=True):
            row = table.loc[(method, 0.0 if noise == "none" else float(noise.removesuffix(" m")))]
            digits = len(cell.split(" ")[0].split(".")[1])
            assert cell == f"{percent(row['svc_percent'] / 100, digits)} ± {row['svc_percent_sd']:.{digits}f}"


def test_what_was_measured_once_stands_where_the_list_of_it_says() -> None:
    listed = pandas.read_csv(RESULTS / "once.csv")
    assert not listed.isna().any(axis=None)
    for one in listed.itertuples():
        assert str(one.shown) in (ROOT / str(one.page)).read_text(encoding="utf-8"), one
        date.fromisoformat(str(one.published))


def _tables(page: Path) -> list[str]:
    """The tables of a page, with single spaces."""
    text = re.sub(r" +", " ", page.read_text(encoding="utf-8"))
    return [re.sub(r"-{3,}", "---", table) for table in _TABLE.findall(text)]
