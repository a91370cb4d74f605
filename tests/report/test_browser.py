"""The page in a browser: it draws, plays, fits a phone, and runs nothing else."""

import re
import shutil

import pytest

from tests.report.test_compare import compared  # noqa: F401
from tests.report.test_data_page import HOSTILE
from tests.report.tuning_case import PLAYED, SECONDS


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium, or a skip with the reason."""
    playwright = pytest.importorskip("playwright.sync_api")
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no Chromium found: install chromium")
    with playwright.sync_playwright() as driver:
        made = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield made
        made.close()


def opened(browser, file, width=1280, height=900, **options):
    """A page, and the list into which complaints and foreign requests go."""
    view = browser.new_page(viewport={"width": width, "height": height}, **options)
    wrong = []
    view.on("console", lambda message: wrong.append(message.text))
    view.on("pageerror", lambda error: wrong.append(str(error)))
    view.on("dialog", lambda dialog: (wrong.append(dialog.message), dialog.dismiss()))
    foreign = lambda url: None if url[:5] in ("file:", "data:") else wrong.append(url)  # noqa: E731
    view.on("request", lambda request: foreign(request.url))
    view.goto(file.as_uri())
    return view, wrong


COLOURS = """canvas => {
  const pen = canvas.getContext("2d");
  const data = pen.getImageData(0, 0, canvas.width, canvas.height).data;
  const found = new Set();
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3] === 255) found.add(data.slice(i, i + 3).join());
  }
  return [...found];
}"""


def clock(view):
    return float(re.search(r": ([\d.]+) s of", view.inner_text("#clock"))[1])


@pytest.mark.browser
def test_it_draws_plays_and_moves_by_keys(browser, file):
    view, wrong = opened(browser, file)
    canvases = view.query_selector_all(".views canvas")
    assert len(canvases) == 4
    for number, canvas in enumerate(canvases):
        own = "213,94,0" if number < 2 else "0,114,178"
        assert own in canvas.evaluate(COLOURS)
    picture = lambda: view.locator(".views canvas").first.evaluate("c => c.toDataURL()")  # noqa: E731
    view.focus("#player")
    view.keyboard.press("Home")
    before = picture()
    view.click("#play")
    for _ in range(100):  # the page's policy forbids Playwright's own waiting
        view.wait_for_timeout(100)
        if clock(view) > 1.0:
            break
    assert clock(view) > 1.0
    view.keyboard.press("Space")
    assert picture() != before
    for key, wanted in (
        ("Home", 0.2), ("ArrowRight", 0.4), ("ArrowLeft", 0.2), ("End", SECONDS),
    ):  # fmt: skip
        view.keyboard.press(key)
        assert clock(view) == pytest.approx(wanted)
    view.click("#events button >> nth=0")
    assert clock(view) < SECONDS - 0.3
    for select, case in (("select", PLAYED[1]), ("link", PLAYED[0])):
        if select == "select":
            view.select_option("#case", "1")
        else:
            view.click("a[data-case='0']")
        assert case in view.inner_text("#clock")
    broken = view.eval_on_selector_all("img", "all => all.filter(x => !x.naturalWidth)")
    nameless = view.eval_on_selector_all(
        "button, select, input, canvas[role=img], svg[role=img], img, [role=region]",
        """all => all.filter((x) => !(x.textContent.trim() || x.ariaLabel || x.alt
          || x.labels?.length)).map((x) => x.outerHTML.slice(0, 80))""",
    )
    assert (broken, nameless, wrong) == ([], [], [])
    view.close()


@pytest.mark.browser
def test_a_phone_needs_no_sideways_scroll_and_markup_in_the_data_does_not_run(
    browser,
    file,
    bare_file,
    hostile_file,
    compared,  # noqa: F811
):
    for shown in (file, bare_file, compared[0], hostile_file):
        view, wrong = opened(browser, shown, width=390, height=844)
        if shown != hostile_file:
            assert view.evaluate("document.documentElement.scrollWidth") <= 390
        else:
            view.click("#events button >> nth=0")
            assert HOSTILE in view.inner_text("#clock") + view.inner_text("#events")
        assert wrong == []
        view.close()
