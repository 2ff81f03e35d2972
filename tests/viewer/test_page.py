"""The page of a run works in a browser, offline: it loads, draws, and obeys mouse and keyboard."""

import re
import shutil

import numpy as np
import pytest
from folding import folding_run

from jaxcrumple import view
from jaxcrumple.io import RunDirectoryError
from jaxcrumple.viewer.page import page

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# Software rendering, as root, and without the services that a browser looks for.
FLAGS = (
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run",
    "--disable-sync", "--disable-background-networking", "--disable-component-update",
)  # fmt: skip


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no Chromium: install it, e.g. apt-get install chromium")
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield opened
        opened.close()


class Opened:
    """A page in the browser, with what it asked for and what went wrong."""

    def __init__(self, browser, path):
        self.tab = browser.new_page(viewport={"width": 1000, "height": 700})
        self.requests, self.errors = [], []
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.on("pageerror", lambda error: self.errors.append(str(error)))
        self.tab.on("console", self._said)
        self.tab.goto(path.resolve().as_uri())
        self.tab.wait_for_function("window.page && window.page.drawn > 0")

    def _said(self, message):
        if message.type == "error":
            self.errors.append(message.text)

    def ask(self, script):
        return self.tab.evaluate(script)

    def look(self):
        """The picture of the space view, after the next frame is drawn."""
        self.ask("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return self.tab.screenshot(clip={"x": 0, "y": 60, "width": 490, "height": 400})


@pytest.fixture(scope="module")
def opened(browser, tmp_path_factory):
    path = view(folding_run(rows=60), tmp_path_factory.mktemp("page") / "a.html")
    opened = Opened(browser, path)
    yield opened
    assert opened.errors == []
    assert opened.requests == [path.resolve().as_uri()]


def test_it_draws_the_last_frame(opened):
    assert opened.ask("page.t") == pytest.approx(0.3)
    run = folding_run()
    now = np.array(opened.ask("Array.from(page.panels[0].surface.now)")).reshape(-1, 3)
    np.testing.assert_allclose(now, run.x[-1], atol=2e-6)
    assert len(set(opened.look())) > 100


def test_the_slider_moves_the_sheet(opened):
    before = opened.look()
    opened.tab.locator("#time").fill("0.05")
    run = folding_run()
    now = np.array(opened.ask("Array.from(page.panels[0].surface.now)")).reshape(-1, 3)
    np.testing.assert_allclose(now, 0.5 * (run.x[0] + run.x[1]), atol=4e-6)
    assert opened.tab.locator("#clock").inner_text() == "0.05000 s"
    assert opened.look() != before


def test_normals_keep_creases_sharp(opened):
    """Of the folded sheet all normals are those of its halves; of the flat one they are equal."""
    opened.ask("page.goTo(0)")
    normals = np.array(opened.ask("Array.from(page.panels[0].surface.normals)")).reshape(-1, 3)
    np.testing.assert_allclose(np.abs(normals @ normals[0]), 1.0, atol=1e-3)


def test_colours_change(opened):
    opened.ask("page.goTo(0.3)")
    pictures = set()
    for field in ("damage", "strain", "paper", "curvature"):
        opened.tab.locator("#field").select_option(field)
        pictures.add(opened.look())
        assert opened.tab.locator("#scale").is_visible() == (field != "paper")
    assert len(pictures) == 4


def test_keys_step_through_the_frames(opened):
    opened.ask("document.activeElement.blur()")
    opened.tab.keyboard.press("Home")
    seen = []
    for key in ("ArrowRight", "ArrowRight", "ArrowLeft", "End"):
        opened.tab.keyboard.press(key)
        seen.append(opened.ask("page.t"))
    assert seen == pytest.approx([0.1, 0.2, 0.1, 0.3])
    opened.tab.keyboard.press(" ")
    assert opened.tab.locator("#play").inner_text() == "Pause"
    opened.tab.keyboard.press(" ")
    assert opened.tab.locator("#play").inner_text() == "Play"
    # Also with the focus on a button.
    opened.tab.locator("#home").focus()
    opened.ask("page.goTo(0.1)")
    opened.tab.keyboard.press("ArrowRight")
    assert opened.ask("page.t") == pytest.approx(0.2)


def test_playing_follows_the_slider(opened):
    opened.ask("page.goTo(0.0)")
    opened.ask("page.play(true)")
    opened.ask("page.goTo(0.2)")
    opened.look()
    assert 0.2 <= opened.ask("page.t") <= 0.3
    opened.ask("page.play(false)")
    stopped = opened.ask("page.t")
    opened.look()
    assert opened.ask("page.t") == stopped


def test_a_point_is_marked_in_both_views(opened):
    opened.ask("page.goTo(0)")
    opened.tab.locator("#walls").set_checked(False)
    box = opened.tab.locator(".pattern").bounding_box()
    opened.tab.mouse.move(box["x"] + 0.5 * box["width"] + 20, box["y"] + 0.5 * box["height"] - 30)
    marked = opened.ask("page.panels[0].marked")
    assert sum(marked["weights"]) == pytest.approx(1.0, abs=1e-6)
    places = "(({flat, space}) => [flat, space].map(v => v.marker.position.toArray()))(page.panels[0])"
    flat, space = opened.ask(places)
    # In the first frame the sheet stands upright: y on the sheet is z in space, and x is stretched by 2 %.
    assert flat[0] > 0 and flat[1] > 0
    assert space == pytest.approx([1.02 * flat[0], 0.0, flat[1]], abs=1e-5)
    assert "mean curvature" in opened.tab.locator(".status").inner_text()
    opened.tab.mouse.move(5, 5)
    assert opened.ask("page.panels[0].marked") is None


def test_keys_mark_a_point_of_the_pattern(opened):
    opened.ask("page.goTo(0.1)")
    opened.tab.locator(".pattern").focus()
    place = "page.panels[0].flat.marker.position.toArray()"
    opened.tab.keyboard.press("ArrowRight")
    middle, half = opened.ask("page.panels[0].flat.middle"), opened.ask("page.panels[0].flat.half")
    assert opened.ask(place)[:2] == pytest.approx(middle, abs=1e-6)
    for key in ("ArrowRight", "ArrowRight", "ArrowUp", "ArrowLeft"):
        opened.tab.keyboard.press(key)
    moved = np.array(opened.ask(place)[:2]) - middle
    np.testing.assert_allclose(moved, half / 20, atol=1e-6)
    status = opened.tab.locator(".status")
    assert "here" in status.inner_text() and status.get_attribute("aria-live") == "polite"
    assert opened.ask("page.t") == pytest.approx(0.1)
    # The mark stays on the sheet.
    for _ in range(25):
        opened.tab.keyboard.press("ArrowUp")
    assert opened.ask("page.panels[0].marked") is not None
    opened.tab.keyboard.press("Escape")
    assert opened.ask("page.panels[0].marked") is None
    opened.ask("document.activeElement.blur()")


def test_valleys_are_dashes(opened):
    run = folding_run()
    ends = run.mesh.vertices[run.mesh.hinges[:, :2]][..., :2]
    for part in (1.0, 0.5):
        found = np.array(opened.ask(f"Array.from(page.panels[0].surface.hingeLines({part}))")).reshape(
            -1, 2, 3
        )
        middle = ends.mean(axis=1, keepdims=True)
        np.testing.assert_allclose(found[..., :2], middle + part * (ends - middle), atol=1e-8)
    shown = opened.ask(
        "(page.goTo(0.3), page.panels[0].lines.map(l => [l.sign, l.geometry.drawRange.count]))"
    )
    assert sorted(shown) == [[-1, 0], [1, 2]]


def test_fit_shows_a_wall_around_the_sheet_whole(opened):
    opened.tab.locator("#walls").set_checked(True)
    opened.ask("page.goTo(0.3)")
    opened.look()
    around, reach = opened.ask("[page.panels[0].around, page.panels[0].reach]")
    radius = opened.ask("page.panels[0].walls.children[0].scale.x")
    apart = opened.ask("page.panels[0].walls.children[0].position.distanceTo(page.panels[0].middle)")
    shown = opened.ask("page.panels[0].space.camera.top")
    assert around == pytest.approx(radius + apart if radius + apart < 1.6 * reach else reach)
    assert shown >= 1.08 * around * (1 - 1e-6)
    opened.tab.locator("#walls").set_checked(False)


def test_drag_turns_and_reset_returns(opened):
    before = opened.ask("page.panels[0].space.camera.position.toArray()")
    box = opened.tab.locator(".space").bounding_box()
    opened.tab.mouse.move(box["x"] + 100, box["y"] + 100)
    opened.tab.mouse.down()
    opened.tab.mouse.move(box["x"] + 180, box["y"] + 120)
    opened.tab.mouse.up()
    assert opened.ask("page.panels[0].space.camera.position.toArray()") != pytest.approx(before)
    opened.tab.locator("#home").click()
    assert opened.ask("page.panels[0].space.camera.position.toArray()") == pytest.approx(before)


def test_everything_to_operate_has_a_name(opened):
    unnamed = opened.ask(
        "[...document.querySelectorAll('button, input, select, [role=img]')].filter(e => !e.hidden && "
        "!(e.ariaLabel || e.textContent.trim() || e.labels?.length)).map(e => e.outerHTML)"
    )
    assert unnamed == []


def test_runs_stand_side_by_side(browser, tmp_path):
    runs = [folding_run(rows=20), folding_run("cylindrical", nodes=150, frames=7)]
    two = Opened(browser, view(runs, tmp_path / "two.html"))
    boxes = [section.bounding_box() for section in two.tab.locator(".run").all()]
    assert len(boxes) == 2 and boxes[1]["x"] >= boxes[0]["x"] + boxes[0]["width"] - 1
    two.ask("page.goTo(0.15)")
    for number, run in enumerate(runs):
        now = np.array(two.ask(f"Array.from(page.panels[{number}].surface.now)")).reshape(-1, 3)
        at = np.apply_along_axis(lambda values, t=run.t: np.interp(0.15, t, values), 0, run.x)
        np.testing.assert_allclose(now, at, atol=4e-6)
    # Arrow keys visit the frames of both.
    two.ask("page.goTo(0)")
    visited = [0.0]
    while len(visited) < 20 and visited[-1] < 0.3:
        two.tab.keyboard.press("ArrowRight")
        visited.append(two.ask("page.t"))
    assert visited == pytest.approx(np.unique(np.round(np.concatenate([run.t for run in runs]), 12)))
    assert two.errors == []


def test_a_run_of_one_frame(browser, tmp_path):
    one = Opened(browser, view(folding_run(frames=1), tmp_path / "one.html"))
    assert one.ask("page.panels[0].surface.frame") == 0
    assert one.ask("page.panels[0].surface.now.every(Number.isFinite)")
    assert one.errors == []


def test_a_page_is_one_file_that_no_name_breaks():
    text = page([folding_run(result="</script><script>alert(1)</script>")], ["<b>&</script>"])
    assert "alert(1)</script>" not in text.replace("\\u003c", "")
    assert "<title>&lt;b&gt;&amp;&lt;/script&gt; - jaxcrumple</title>" in text
    outside = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert not re.findall(r"(?:src|href)\s*=", outside)
    assert "MIT License" in text


def test_wrong_input_is_refused(tmp_path):
    with pytest.raises(ValueError, match="there is no run to view"):
        view([], tmp_path / "a.html")
    with pytest.raises(RunDirectoryError, match="does not exist"):
        view(tmp_path / "none", tmp_path / "a.html")
    with pytest.raises(RunDirectoryError, match="cannot write"):
        view(folding_run(), tmp_path / "nowhere" / "a.html")
