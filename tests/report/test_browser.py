"""The report in a real browser: ``pip install playwright``, and Chromium by ``apt-get install chromium``."""

import shutil
from datetime import UTC, datetime

import pytest

from torchrl_mcp.report.page import report
from torchrl_mcp.report.results import find_runs

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
CHROMIUM = next(filter(None, map(shutil.which, ["chromium", "chromium-browser", "google-chrome"])), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed: apt-get install chromium")


@pytest.fixture(scope="module")
def address(run_writers, tmp_path_factory):
    """A report with wide tables, long names and learning curves."""
    folder = tmp_path_factory.mktemp("report")
    write_run, write_mcp = run_writers(folder / "runs")
    gates = {"gates/sum": 1.5, "gates/effective_primitives": 2.0, **{f"gates/usage_{k}": 0.1 * k for k in range(8)}}
    for seed in range(2):
        write_run(f"a/rather/long/{'name/' * 20}{seed}", seed=seed, score=0.5 + 0.1 * seed)
        write_mcp(f"mcp-{seed}", seed=seed, score=0.7, diagnostics=gates)
        write_mcp(f"k-{seed}", seed=seed, score=0.7, num_primitives=4, some__very__long__name="x" * 80)
    write_run("unfinished", seed=2, progress=0.5)
    (write_run("damaged", score=0.5) / "config.yaml").write_text("[")
    runs, damaged = find_runs([folder / "runs"])
    pages = report(runs, damaged, moment=datetime(2026, 1, 2, tzinfo=UTC))
    (folder / "report.html").write_text(pages["report.html"], encoding="utf-8")
    return (folder / "report.html").as_uri()


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        # Chromium's sandbox does not start for root, as in containers; the page is our own.
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def visit(browser, address):
    """Opens the report, and what it asked for and complained of."""
    contexts = []

    def visit(**settings):
        context = browser.new_context(**settings)
        contexts.append(context)
        page, said, requested = context.new_page(), [], []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: requested.append(request.url))
        page.goto(address)
        return page, said, requested

    yield visit
    for context in contexts:
        context.close()


def colour(page, selector, name):
    return page.eval_on_selector(selector, f"element => getComputedStyle(element)['{name}']")


def lightness(page, selector, name):
    red, green, blue = (float(x) for x in colour(page, selector, name).strip("rgb()").split(","))
    return (0.2126 * red + 0.7152 * green + 0.0722 * blue) / 255


@pytest.mark.parametrize("width", [390, 1280])
def test_tables_scroll_in_their_own_container_and_the_page_does_not(visit, width):
    page, _, _ = visit(viewport={"width": width, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") == width
    tables = page.eval_on_selector_all(".scroll", "all => all.map(e => [e.scrollWidth, e.clientWidth, e.offsetLeft])")
    assert all(left + visible <= width for _, visible, left in tables)
    if width == 390:
        assert any(whole > visible for whole, visible, _ in tables)


def test_the_page_asks_for_nothing_and_complains_of_nothing(visit, address):
    _, said, requested = visit()
    assert (said, requested) == ([], [address])


def test_the_dark_theme_is_light_on_dark_and_the_light_one_dark_on_light(visit):
    for scheme, background, text in (("light", 1.0, 0.0), ("dark", 0.0, 1.0)):
        page, _, _ = visit(color_scheme=scheme)
        assert lightness(page, "body", "backgroundColor") == pytest.approx(background, abs=0.15)
        for element in ("h1", "td", "caption", "figcaption", "figure svg text"):
            assert abs(lightness(page, element, "color") - background) > 0.45
        assert lightness(page, "h1", "color") == pytest.approx(text, abs=0.2)


def test_lines_of_curves_follow_the_theme(visit):
    strokes = [colour(visit(color_scheme=scheme)[0], ".legend path", "stroke") for scheme in ("light", "dark")]
    assert strokes[0] != strokes[1]


def test_numbers_are_right_aligned_with_figures_of_one_width(visit):
    page, _, _ = visit()
    assert colour(page, "td.number", "textAlign") == "right"
    assert colour(page, "td.number", "fontVariantNumeric") == "tabular-nums"


@pytest.mark.parametrize("width", [390, 1280])
def test_a_plots_words_stay_legible_and_inside_it(visit, width):
    page, _, _ = visit(viewport={"width": width, "height": 800})
    inside = """svg => {
        const frame = svg.getBoundingClientRect();
        return [...svg.querySelectorAll('text')].map(text => text.getBoundingClientRect()).every(
            box => box.left >= frame.left - 1 && box.right <= frame.right + 1 && box.bottom <= frame.bottom + 1
        )
    }"""
    assert page.eval_on_selector("figure > svg", inside)
    size = "svg => svg.getBoundingClientRect().width / svg.viewBox.baseVal.width * 9"
    assert page.eval_on_selector("figure > svg", size) > 8.5
