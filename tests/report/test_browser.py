"""The pages in a browser: drawn without a complaint or a request, sorted, saved, dark and printed.

Without a Chromium (on the path, or playwright's own) there is nothing to test with.
"""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.cells import kr270_cell, kr270_chain
from support.diagnoses import EXPLAINED, HOSTILE

from elastocal.diagnosis.baseline import Baseline
from elastocal.model.manipulator import Model
from elastocal.report.renderers import page_of

playwright = pytest.importorskip("playwright.sync_api")

# WebGL by software, where there is no graphics card; a container's root has no sandbox.
ARGUMENTS = ("--no-sandbox", "--no-first-run", "--disable-background-networking",
             "--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # fmt: skip
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE = 120_000  # ms until a page must have drawn; software rendering may be slow
KINDS = ("identification", "diagnosis", "plan")
LIGHT, DARK = 0.8, 0.2  # luminance of a page's paper


@dataclass
class Opened:
    """A page with all that it complained of and asked for."""

    page: Any
    file: Path
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as started:
        own = started.chromium.executable_path
        found = next(filter(None, map(shutil.which, NAMES)), own)
        if not Path(found).exists():
            pytest.skip(f"no Chromium: none of {', '.join(NAMES)} on the path, nor {own}")
        running = started.chromium.launch(executable_path=found, args=list(ARGUMENTS))
        yield running
        running.close()


@pytest.fixture(scope="module")
def texts(hostile: Any, plan: Any) -> dict[str, str]:
    observed = hostile.result.observations
    model = hostile.result.model
    base = Baseline(model, observed, hostile.result.x, np.ones(len(model.names)),
                    hostile.result.residual, hostile.result.residual, None)  # fmt: skip
    arm = Model.assembled(kr270_chain(), kr270_cell(("base_frame",)))
    return {
        "identification": page_of(hostile.result, command="elastocal identify"),
        "diagnosis": page_of(replace(EXPLAINED, calibrated=base, model=arm, data=HOSTILE)),
        "plan": page_of(plan),
    }


@pytest.fixture(scope="module")
def opened(
    browser: Any, texts: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Opened]:
    folder = tmp_path_factory.mktemp("pages")
    return {kind: show(browser, folder / f"{kind}.html", text) for kind, text in texts.items()}


def show(browser: Any, file: Path, text: str) -> Opened:
    file.write_text(text, encoding="utf-8")
    page = browser.new_page(viewport={"width": 1100, "height": 800})
    found = Opened(page, file)

    def heard(message: Any) -> None:
        # What the graphics driver says of its speed is not the page's business.
        if message.type in ("error", "warning") and "GL Driver Message" not in message.text:
            found.complaints.append(message.text)

    page.on("console", heard)
    page.on("pageerror", lambda error: found.complaints.append(str(error)))
    page.on("dialog", lambda dialog: (found.complaints.append("dialog"), dialog.dismiss()))
    page.on("request", lambda request: found.requests.append(request.url))
    page.goto(file.as_uri())
    page.wait_for_selector("html.ready", state="attached", timeout=PATIENCE)
    page.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    page.wait_for_selector("figure.view.drawn", timeout=PATIENCE)
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_every_figure_is_drawn_without_complaint_or_request(
    opened: dict[str, Opened], kind: str
) -> None:
    found, page = opened[kind], opened[kind].page
    assert [text for text in found.complaints if "willReadFrequently" not in text] == []
    assert [url for url in found.requests if not url.startswith("blob:")] == [found.file.as_uri()]
    assert found.file.stat().st_size < 6e6
    boxes = page.evaluate(
        """[...document.querySelectorAll('figure')].map(figure => {
          const shown = [...figure.querySelectorAll('.still > svg, .plot, figure > svg, svg')]
            .map(e => e.getBoundingClientRect()).filter(b => b.width > 0 && b.height > 0);
          return shown.length ? Math.max(...shown.map(b => b.height)) : 0;
        })"""
    )
    assert len(boxes) >= (1 if kind == "plan" else 2)
    assert min(boxes) > 50
    assert page.locator("figure.view.drawn").count() == 1
    traces = page.evaluate(
        """(() => { const plot = document.querySelector('.plot');
          return plot.data.map(t => [t.name, t.x.filter(Number.isFinite).length]); })()"""
    )
    sizes = dict(traces)
    assert sizes["arm"] > 100 and sizes["markers"] >= 1
    assert ("residuals" in sizes) == (kind != "plan")
    canvas = page.locator(".plot canvas").first.bounding_box()
    assert canvas["width"] > 300 and canvas["height"] > 200


def test_another_pose_moves_arm_and_arrows_and_the_view_keeps_its_turn(
    opened: dict[str, Opened],
) -> None:
    page = opened["identification"].page
    drawn = "[...document.querySelector('.plot').data].map(t => t.x[0])"
    camera = "document.querySelector('.plot').layout.scene.camera.eye.x"
    before, told = page.evaluate(drawn), page.locator(".controls output").inner_text()
    assert "arrows drawn" in told
    page.evaluate(
        """Plotly.relayout(document.querySelector('.plot'),
          {'scene.camera': {eye: {x: 0.3, y: 0.4, z: 1.5}}})"""
    )
    first = page.locator("select.pose").input_value()
    page.select_option("select.pose", "0" if first != "0" else "1")
    assert page.evaluate(drawn) != before
    assert page.locator(".controls output").inner_text() != told
    assert page.evaluate(camera) == pytest.approx(0.3)
    page.select_option("select.pose", first)
    # The wheel scrolls the page.
    canvas = page.locator(".plot canvas").first
    canvas.scroll_into_view_if_needed()
    box, above = canvas.bounding_box(), page.evaluate("scrollY")
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.wheel(0, 200)
    page.wait_for_function("was => scrollY > was", arg=above)
    assert page.evaluate(camera) == pytest.approx(0.3)


@pytest.mark.parametrize("kind", KINDS)
def test_tables_are_filled_and_sorted_by_click_and_key(
    opened: dict[str, Opened], kind: str
) -> None:
    page = opened[kind].page
    counts = page.evaluate(
        """[...document.querySelectorAll('table.data')].map(t =>
          [t.dataset.name, t.querySelectorAll('tbody tr:not(.group) td:first-child').length])"""
    )
    assert counts and all(n > 0 for _, n in counts)
    name = {"identification": "residuals", "diagnosis": "candidates", "plan": "poses"}[kind]
    column = {"identification": 3, "diagnosis": 2, "plan": 1}[kind]
    table = page.locator(f"table[data-name='{name}']")
    head, button = table.locator("th[scope=col]").nth(column), table.locator("button").nth(column)
    cells = table.locator(f"tbody tr:not(.group) td:nth-child({column + 1})")
    initial = cells.all_inner_texts()
    button.click()
    assert head.get_attribute("aria-sort") == "ascending"
    numbers = [float(t.replace("−", "-")) for t in cells.all_inner_texts() if t]
    assert numbers == sorted(numbers) and len(set(numbers)) > 1
    button.focus()
    page.keyboard.press("Enter")
    assert head.get_attribute("aria-sort") == "descending"
    numbers = [float(t.replace("−", "-")) for t in cells.all_inner_texts() if t]
    assert numbers == sorted(numbers, reverse=True)
    page.keyboard.press("Enter")
    assert head.get_attribute("aria-sort") == "none"
    assert cells.all_inner_texts() == initial


def test_a_table_saved_as_csv_has_its_rows(opened: dict[str, Opened]) -> None:
    page, name = opened["diagnosis"].page, "error-budget"
    table = page.locator(f"table[data-name='{name}']")
    shown = [
        row.locator("td").all_inner_texts() for row in table.locator("tbody tr:not(.group)").all()
    ]
    with page.expect_download() as download:
        page.get_by_label(f"Save the table {name} as CSV").click()
    assert download.value.suggested_filename == f"{name}.csv"
    text = Path(download.value.path()).read_text(encoding="utf-8-sig")
    heads, *rows = csv.reader(io.StringIO(text))
    assert heads == table.locator("th[scope=col]").all_inner_texts()
    expected = [[" ".join(cell.split()).replace("−", "-") for cell in row] for row in shown]
    assert [[cell.replace("−", "-") for cell in row] for row in rows] == expected


@pytest.mark.parametrize("kind", KINDS)
def test_dark_print_and_narrow(opened: dict[str, Opened], kind: str) -> None:
    page = opened[kind].page
    try:
        assert paper(page) > LIGHT
        light = page.evaluate("document.querySelector('.plot').layout.font.color")
        page.emulate_media(color_scheme="dark")
        assert paper(page) < DARK
        page.wait_for_function(
            "was => document.querySelector('.plot').layout.font.color !== was", arg=light
        )
        page.emulate_media(color_scheme="dark", media="print")
        assert paper(page) > LIGHT
        assert page.locator(".still").is_visible() and not page.locator(".live").is_visible()
        page.emulate_media(color_scheme="light", media="screen")
        assert page.locator(".live").is_visible() and not page.locator(".still").is_visible()
        page.set_viewport_size({"width": 400, "height": 800})
        page.wait_for_function("() => document.documentElement.scrollWidth <= 400")
        # Nothing has to be scrolled that does not show it.
        hidden = page.evaluate(
            """[...document.querySelectorAll('main *, table, td, figure, svg, dl')].filter(e =>
              e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 0
              && getComputedStyle(e).overflowX !== 'visible').map(e => e.className)"""
        )
        assert hidden == []
        # Letters of figures are drawn at least 7 pixels high.
        sizes = page.evaluate(
            """[...document.querySelectorAll('figure > svg text')].map(e =>
              parseFloat(getComputedStyle(e).fontSize) * e.getScreenCTM().a)"""
        )
        assert min([s for s in sizes if s > 0], default=7) >= 7
        # On paper, A4 without margins of 1 cm: no short table is cut, heads are repeated.
        page.emulate_media(media="print")
        page.set_viewport_size({"width": 718, "height": 1000})
        tables = page.locator("table.data").all()
        lengths = [table.locator("tbody tr").count() for table in tables]
        for table, rows in zip(tables, lengths, strict=True):
            expected = "avoid" if rows <= 12 else "auto"
            assert table.evaluate("e => getComputedStyle(e).breakInside") == expected
        assert min(lengths) <= 12
        # A button's own box is not painted where Chromium repeats a head.
        shown = page.evaluate(
            "[...document.querySelectorAll('button.sort')].map(e => getComputedStyle(e).display)"
        )
        assert set(shown) == {"contents"}
        assert page.evaluate("document.documentElement.scrollWidth") <= 718
    finally:
        page.emulate_media(color_scheme="light", media="screen")
        page.set_viewport_size({"width": 1100, "height": 800})


def paper(page: Any) -> float:
    """Luminance of the page's background, 0 to 1."""
    text = page.evaluate("getComputedStyle(document.body).backgroundColor")
    red, green, blue = (int(v) for v in text.strip("rgb()").split(",")[:3])
    return (0.2126 * red + 0.7152 * green + 0.0722 * blue) / 255


def test_without_script_everything_else_is_there(browser: Any, opened: dict[str, Opened]) -> None:
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(opened["identification"].file.as_uri())
    page.locator("summary", has_text="Residuals on the arm").click()
    assert page.locator(".still svg").is_visible()
    assert page.locator("table[data-name='parameters'] td").first.is_visible()
    context.close()


def test_cells_of_a_csv_are_harmless_and_lengths_are_sorted_whatever_their_unit(
    opened: dict[str, Opened],
) -> None:
    page = opened["plan"].page
    cells = {
        "−0.5": "-0.5", "=HYPERLINK(1)": "'=HYPERLINK(1)", "@x": "'@x", "+name": "'+name",
        "+0.5": "+0.5", 'a "b", c': '"a ""b"", c"',
    }  # fmt: skip
    assert page.evaluate("names => names.map(csvCell)", list(cells)) == list(cells.values())
    expected = ["< 0.001 µm", "53.0 µm", "424 µm", "1.98 mm", "1.2 m", "word", "–"]
    found = page.evaluate(
        """texts => texts.map(t => [sortKey(t), t]).sort((a, b) => compare(a[0], b[0], 1))
          .map(pair => pair[1])""",
        sorted(expected),
    )
    assert found == expected
