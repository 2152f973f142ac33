"""The page in a real browser: every control, for eyes and for a keyboard, on a desk and on a phone."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.study.browser import FLAGS, require_browser
from tests.study.pages import small_page
from tint_sumo.study.page import write_page
from tint_sumo.study.page.recording import UNITS, read_episodes
from tint_sumo.study.report import write_report

sync_api = pytest.importorskip("playwright.sync_api", reason='no browser tests without: pip install "tint_sumo[dev]"')
axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason='needs: pip install "tint_sumo[dev]"')

DESK, PHONE = {"width": 1280, "height": 900}, {"width": 360, "height": 740}
GRAVE = ("serious", "critical")
# The name and the outline of what has the focus; nothing when it has left the page.
_FOCUSED = """(() => {
  const one = document.activeElement;
  if (one === document.body) return null;
  const name = one.id || one.className || (one.tagName === "BUTTON" ? one.textContent : one.tagName);
  return [name, getComputedStyle(one).outlineStyle];
})()"""


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    require_browser()
    out = tmp_path_factory.mktemp("study")
    small_page(out)
    hide_a_vehicle(out / "episodes" / "ttc.json")
    write_page(write_report(out), out, progress=False)
    return out


def hide_a_vehicle(file: Path) -> None:
    """As a sensor does; and let the policy estimate the town."""
    content = json.loads(file.read_text())
    episode = content["episodes"]["0"]
    first = next(one for one in episode["vehicles"] if one["first"] == 0)
    first["seen"] = [0] * len(first["x_m"])
    episode["ego"] |= {"town_rank": [79], "town_differs": [92]}
    file.write_text(json.dumps(content))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    path = require_browser()
    with sync_api.sync_playwright() as playwright:
        one = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        yield one
        one.close()


class Opened:
    """The page, and all that went wrong in it."""

    def __init__(self, browser: Any, file: Path, **options: Any) -> None:
        self.context = browser.new_context(**{"viewport": DESK, **options})
        self.page = self.context.new_page()
        self.troubles: list[str] = []
        self.page.on("console", lambda message: self.troubles.append(f"{message.type}: {message.text}"))
        self.page.on("pageerror", lambda error: self.troubles.append(str(error)))
        self.page.on("request", self._request)
        self.page.goto(file.as_uri())
        self.page.wait_for_selector(".chart .main-svg", state="attached")
        self.page.wait_for_selector("#neighbours button")
        self.wait()

    def wait(self) -> None:
        """Wait until the player shows what was chosen."""
        self.page.wait_for_selector("#theatre[aria-busy=false]")

    def _request(self, request: Any) -> None:
        if not request.url.startswith(("file:", "data:")):
            self.troubles.append(request.url)

    def text(self, selector: str) -> str:
        return str(self.page.text_content(selector))

    @property
    def frame(self) -> int:
        return int(self.page.input_value("#frame"))

    def facts(self, pane: int = 0) -> dict[str, str]:
        names, values = (
            self.page.locator(".pane").nth(pane).locator(part).all_text_contents() for part in ("dt", "dd")
        )
        return dict(zip(names, values, strict=True))

    def places(self, pane: int = 0) -> list[str]:
        """Return the positions at which vehicles are drawn, the ego last."""
        found = self.page.locator(".pane").nth(pane).locator("g:last-of-type > g[transform]")
        return [str(one.get_attribute("transform")) for one in found.all()]


@pytest.fixture
def opened(browser: Any, study: Path) -> Iterator[Opened]:
    one = Opened(browser, study / "report.html")
    yield one
    assert one.troubles == []
    one.context.close()


def choose(opened: Opened, method: str, case: str, beside: str = "") -> None:
    opened.page.locator(".pane select").nth(0).select_option(method)
    opened.page.locator(".pane select").nth(1).select_option(beside)
    opened.page.locator("#case").select_option(case)
    opened.wait()


@pytest.mark.parametrize("viewport", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.parametrize("colours", ["light", "dark"])
def test_the_page_keeps_nobody_out(browser: Any, study: Path, viewport: dict[str, int], colours: str) -> None:
    opened = Opened(browser, study / "report.html", viewport=viewport, color_scheme=colours, reduced_motion="reduce")
    page = opened.page
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (background == "rgb(255, 255, 255)") == (colours == "light")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.locator(".pane select").nth(1).select_option("ttc")
    for fold in page.locator("summary:visible").all():
        fold.click()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    if viewport == PHONE:
        boxes = page.locator(".scrolls:visible")
        wide = "one => one.scrollWidth > one.clientWidth ? [one.getAttribute('aria-label')] : []"
        assert boxes.count() > 5 and page.evaluate(f"[...document.querySelectorAll('.scrolls')].flatMap({wide})") == []
        assert "method" not in page.locator("#results tbody tr").first.inner_text()
    found = axe.Axe().run(page).response["violations"]
    assert [(one["id"], [node["target"] for node in one["nodes"]][:3]) for one in found if one["impact"] in GRAVE] == []
    assert opened.troubles == []
    opened.context.close()


def test_the_player_shows_what_was_recorded(opened: Opened, study: Path) -> None:
    episodes = read_episodes(study / "episodes" / "always_go.json")
    choose(opened, "always_go", "2")
    episode, frame = episodes[2], 40
    opened.page.fill("#frame", str(frame))
    there = [one for one in episode["vehicles"] if one["first"] <= frame < one["first"] + len(one["x_m"])]
    assert len(there) == len(opened.places()) - 1 > 3
    x, y, heading = (
        UNITS[name] * float(np.cumsum(episode["ego"][name])[frame]) for name in ("x_m", "y_m", "heading_deg")
    )
    drawn = [float(part) for part in re.findall(r"-?[\d.]+(?:e-?\d+)?", opened.places()[-1])]
    assert drawn == pytest.approx([x, -y, -heading], abs=1e-6)
    letters = opened.page.locator(".pane").nth(0).locator("g > text").all_text_contents()
    assert letters == ["CA"[one["trait"]] for one in there] + ["E"]
    assert opened.facts()["time"] == "4.0 s" and opened.facts()["outcome"] == "still open"
    assert opened.facts()["value"] == "none"
    opened.page.keyboard.press("End")
    assert opened.facts()["outcome"] == episode["outcome"] == "collision"


def test_inferred_traits_attention_and_claims_are_seen_and_told(opened: Opened, study: Path) -> None:
    episodes = read_episodes(study / "episodes" / "vae-shipped.json")
    choose(opened, "vae-shipped", "0")
    pane = opened.page.locator(".pane").nth(0)
    pane.locator("summary").click()
    claimed = np.cumsum(episodes[0]["routes"]["lower"]["claimed"])
    frame = int(claimed.argmax())
    assert claimed[frame] == 1 and frame > 20
    for at, count in ((frame - 1, 0), (frame, 1)):
        opened.page.fill("#frame", str(at))
        assert pane.locator(".route.claimed").count() == count
    assert "lower" in opened.facts()["claims"]
    assert float(opened.facts()["value"]) != 0.0
    rows = [row.split("\t") for row in pane.locator("table").inner_text().splitlines()]
    assert rows[0] == ["vehicle", "true trait", "taken for", "attention", "brakes", "seen"]
    assert len(rows) == len(opened.places())
    assert {row[5] for row in rows[1:]} == {"yes"} and pane.locator("g.hidden").count() == 0
    hatched = sum(row[2].startswith("aggressive") for row in rows[1:])
    assert pane.locator("g.hatched").count() == hatched > 0
    weights = [int(row[3].split()[0]) for row in rows[1:]]
    assert sum(weights) == pytest.approx(100, abs=len(weights))
    assert pane.locator("circle.halo").count() == pytest.approx(sum(weight > 3 for weight in weights), abs=1)


def test_vehicles_that_are_not_seen_are_pale_and_the_town_is_described(opened: Opened) -> None:
    choose(opened, "ttc", "0")
    pane = opened.page.locator(".pane").nth(0)
    pane.locator("summary").click()
    assert opened.facts()["town"] == "gaps longer than in 79 % of towns, drivers differ with 92 %"
    hidden = pane.locator("svg g.hidden")
    assert hidden.count() == 1 and hidden.evaluate("one => getComputedStyle(one).opacity") == "0.35"
    assert hidden.locator("title").text_content().endswith(", not seen")
    rows = [row.split("\t") for row in pane.locator("table").inner_text().splitlines()]
    assert sorted({row[5] for row in rows[1:]}) == ["no", "yes"]


def test_every_button_and_key_moves_both_policies_through_the_same_case(opened: Opened) -> None:
    choose(opened, "always_go", "0", beside="ttc")
    page = opened.page
    last = int(str(page.get_attribute("#frame", "max")))
    assert opened.facts(0)["time"] == opened.facts(1)["time"] == "0.0 s"
    assert opened.places(0)[:-1] == opened.places(1)[:-1]  # the same traffic
    for button, frame in (("#forward", 1), ("#forward", 2), ("#back", 1), ("#to-end", last), ("#back", last - 1)):
        page.click(button)
        assert opened.frame == frame
    page.click("#to-start")
    page.focus("#stage")
    for key, frame in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", last), ("Home", 0)):
        page.keyboard.press(key)
        assert opened.frame == frame
    page.keyboard.press("ArrowLeft")
    assert opened.frame == 0
    page.keyboard.press("End")
    times = {opened.facts(pane)["time"] for pane in (0, 1)}
    assert f"{last / 10:.1f} s" in times and len(times) == 2  # the shorter episode stays at its end
    assert {opened.facts(pane)["outcome"] for pane in (0, 1)} <= {"success", "timeout", "collision"}
    status = opened.text("#player-status")
    assert status.startswith("always go: time ") and "time to collision: time " in status
    pictures = page.locator(".pane > svg")
    assert pictures.nth(0).is_visible() and pictures.nth(1).is_visible()
    choose(opened, "always_go", "0")
    assert pictures.nth(0).is_visible() and not pictures.nth(1).is_visible()


def test_it_plays_only_when_told_and_at_the_chosen_speed(browser: Any, study: Path) -> None:
    opened = Opened(browser, study / "report.html", reduced_motion="reduce")
    page, clock = opened.page, opened.page.clock
    clock.install(time=0)
    clock.pause_at(1)  # from here on the page's time passes when the test says so
    clock.run_for(1000)
    assert (opened.frame, opened.text("#play")) == (0, "Play")
    page.select_option("#speed", "4")
    page.focus("#stage")
    page.keyboard.press("Space")
    assert opened.text("#play") == "Pause" and opened.text("#player-status") == "Playing"
    clock.run_for(700)
    page.keyboard.press("Space")
    assert opened.text("#play") == "Play" and opened.text("#player-status").startswith("Paused. ")
    stopped = opened.frame
    assert stopped in (27, 28)  # 0.7 s at four times the speed are 28 frames of 0.1 s; the last may be due
    clock.run_for(1000)
    assert opened.frame == stopped
    page.click("#to-end")
    page.click("#back")
    page.click("#play")
    clock.run_for(100)
    assert opened.text("#play") == "Play"  # at the end it stops
    page.click("#play")
    assert (opened.frame, opened.text("#play")) == (0, "Pause")  # and begins again
    opened.context.close()


@pytest.mark.parametrize("how", ["click", "tap", "Enter"])
def test_failures_open_in_the_player(browser: Any, study: Path, how: str) -> None:
    opened = Opened(browser, study / "report.html", has_touch=True)
    opened.page.locator("#failures summary").first.click()
    button = opened.page.locator("#failures button", has_text="Case 2").first
    words = str(button.text_content())
    {"click": button.click, "tap": button.tap, "Enter": lambda: button.press("Enter")}[how]()
    opened.page.wait_for_selector("#stage:focus")
    assert opened.page.input_value("#case") == "2"
    assert opened.page.locator(".pane select").first.input_value() == button.get_attribute("data-policy")
    opened.page.keyboard.press("End")
    outcome, time_s = re.findall(r"2: (\w+) after ([\d.]+ s)", words)[0]
    assert (opened.facts()["outcome"], opened.facts()["time"]) == (outcome, time_s)
    assert opened.troubles == []
    opened.context.close()


def test_the_list_says_how_often_each_policy_failed(opened: Opened) -> None:
    assert "2 collisions and 0 timeouts in 3 cases" in opened.text("#failures")


def test_the_keyboard_alone_reaches_every_control_and_shows_where_it_is(opened: Opened) -> None:
    page, seen = opened.page, []
    page.evaluate("document.querySelectorAll('#failures details').forEach(one => one.open = true)")
    page.keyboard.press("Tab")
    while (at := page.evaluate(_FOCUSED)) is not None:
        name, outline = at
        assert outline != "none", name
        seen.append(name)
        page.keyboard.press("Tab")
    steering = {"case", "speed", "play", "back", "forward", "to-start", "to-end", "frame", "stage"}
    assert steering | {"theme", "model", "space"} <= set(seen)
    assert seen[0] == "skip"
    assert page.locator("#failures button").count() == sum(name.startswith("Case ") for name in seen) > 3
    assert page.locator("summary:visible").count() == seen.count("SUMMARY") > 3


def test_the_button_turns_the_colours(opened: Opened) -> None:
    page = opened.page
    ink = "getComputedStyle(document.querySelector('.chart .xtick text')).fill"
    assert opened.text("#theme") == "Dark colours"
    before = page.evaluate(ink)
    page.click("#theme")
    assert opened.text("#theme") == "Light colours"
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(22, 24, 27)"
    assert page.evaluate(ink) != before
    page.click("#theme")
    assert page.evaluate(ink) == before


def test_windows_of_the_latent_space_by_pointer_touch_and_keyboard(browser: Any, study: Path) -> None:
    opened = Opened(browser, study / "report.html", has_touch=True)
    page, texts = opened.page, []
    page.locator("#space").scroll_into_view_if_needed()
    for number, act in ((50, "hover"), (120, "tap")):
        box = page.locator(f".point[data-window='{number}']").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y) if act == "hover" else page.touchscreen.tap(x, y)
        texts.append(opened.text("#window-text"))
    page.focus("#space")
    for key in ("Home", "ArrowRight", "ArrowLeft", "ArrowDown", "ArrowUp"):
        page.keyboard.press(key)
        texts.append(opened.text("#window-text"))
    assert len(set(texts)) >= 4
    assert all(re.match(r"Window of driver \d+, (conservative|aggressive) in truth", text) for text in texts)
    assert page.locator(".point.chosen").count() == 1 and page.locator(".point.near").count() == 5
    neighbour = page.locator("#neighbours button").first
    name = str(neighbour.text_content()).split(",")[0]
    neighbour.press("Enter")
    assert opened.text("#window-text").startswith(f"Window of {name},")
    assert page.locator("#window-offsets .trace").count() == 6
    assert opened.troubles == []
    opened.context.close()


def test_the_page_runs_no_script_but_its_own(browser: Any, study: Path, tmp_path: Path) -> None:
    injected = """
        <script>window.ran = "inline"</script>
        <script type="module">window.ran = "module"</script>
        <script src="data:text/javascript,window.ran='data'"></script>
        <img src="data:," onerror="window.ran = 'handler'">
        <a href="javascript:window.ran = 'link'">injected</a>
        <style>body { color: red }</style>
    """
    page_file = tmp_path / "report.html"
    text = (study / "report.html").read_text(encoding="utf-8")
    page_file.write_text(text.replace("<main", f"{injected}<main", 1), encoding="utf-8")
    assert "unsafe-inline" not in re.sub("style-src-attr 'unsafe-inline'", "", text)
    opened = Opened(browser, page_file)
    opened.page.click("a[href^=javascript]")
    opened.page.evaluate("document.body.append(Object.assign(document.createElement('script'), {text: 'ran = 1'}))")
    assert opened.page.evaluate("typeof window.ran") == "undefined"
    assert opened.page.evaluate("getComputedStyle(document.body).color") != "rgb(255, 0, 0)"
    assert len([one for one in opened.troubles if "Content Security Policy" in one]) >= 7
    opened.context.close()


def test_print_has_light_charts_and_open_tables(browser: Any, study: Path) -> None:
    opened = Opened(browser, study / "report.html", color_scheme="dark")
    page = opened.page
    shut = page.locator("details:not([open])").count()
    page.evaluate(
        "addEventListener('afterprint', () => 0);"
        "addEventListener('beforeprint', () => { window.printed = {"
        " shut: document.querySelectorAll('details:not([open])').length,"
        " ink: getComputedStyle(document.querySelector('.chart .xtick text')).fill,"
        " width: document.querySelector('.chart .main-svg').clientWidth }; })"
    )
    assert page.pdf(format="A4").startswith(b"%PDF")
    printed = json.loads(page.evaluate("JSON.stringify(window.printed)"))
    assert printed == {"shut": 0, "ink": "rgb(29, 33, 38)", "width": 680}
    assert page.locator("details:not([open])").count() == shut > 0
    assert opened.troubles == []
    opened.context.close()
