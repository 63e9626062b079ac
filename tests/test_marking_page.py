"""The page of `mmmgpu mark` in a real browser: Chromium, driven by Playwright.

Without one these tests are skipped; where MMMGPU_REQUIRE_BROWSER=1 that is a failure.
"""

import base64
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from marked import shown_frames

from mmmgpu.marking import NAMES, Session, warped_onto
from mmmgpu.marking_server import MarkingServer, serving
from mmmgpu.points import read_points

WINDOW = {"width": 1280, "height": 720}


@pytest.fixture
def server(tmp_path):
    with serving(Session(tmp_path / "ann-ben.json", shown_frames())) as server:
        yield server


@dataclass(frozen=True)
class Page:
    """The open page, and the session behind it."""

    tab: object
    server: MarkingServer

    @property
    def session(self):
        return self.server.session

    def settle(self):
        """Wait until the server has every change and what came of it is shown."""
        self.tab.wait_for_selector("#work[aria-busy=false]")

    def press(self, *keys):
        for key in keys:
            self.tab.keyboard.press(key)
        self.settle()

    def click(self, selector):
        self.tab.click(selector)
        self.settle()

    def points(self, kind="closed"):
        """The points that the server has, by name: (a, b)."""
        pairs = {pair["kind"]: pair for pair in self.session.describe()["pairs"]}
        return {p["name"]: (p["a"], p["b"]) for p in pairs[kind]["points"]}

    def select(self, name):
        self.click(f"#list li:text-is('{name}')")

    def selected(self):
        row = self.tab.locator("#list li[aria-selected=true]")
        return row.evaluate("row => row.firstChild.textContent") if row.count() else None

    def screen(self, side, place):
        """Where a place of a picture is on the screen."""
        x, y, width, height = self.tab.evaluate(
            "id => document.getElementById(id).getAttribute('viewBox').split(' ').map(Number)",
            f"picture-{side}",
        )
        box = self.tab.locator(f"#picture-{side}").bounding_box()
        scale = box["width"] / width
        assert abs(scale * height - box["height"]) < 1
        return box["x"] + (place[0] - x) * scale, box["y"] + (place[1] - y) * scale

    def scale(self, side):
        (x0, _), (x1, _) = (self.screen(side, (x, 0)) for x in (0, 1))
        return x1 - x0

    def click_at(self, side, place):
        self.tab.mouse.click(*self.screen(side, place))
        self.settle()

    def drag(self, side, start, end):
        self.tab.mouse.move(*self.screen(side, start))
        self.tab.mouse.down()
        self.tab.mouse.move(*self.screen(side, np.add(start, end) / 2))
        self.tab.mouse.move(*self.screen(side, end))
        self.tab.mouse.up()
        self.settle()

    def messages(self):
        return self.tab.inner_text("#messages")

    def warped(self):
        """The small picture of A carried onto B, as it is shown."""
        data = self.tab.evaluate(
            """async () => {
                const image = new Image();
                image.src = document.querySelector('#warped image').getAttribute('href');
                await image.decode();
                const canvas = document.createElement('canvas');
                [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
                canvas.getContext('2d').drawImage(image, 0, 0);
                return canvas.toDataURL('image/png').split(',')[1];
            }"""
        )
        png = np.frombuffer(base64.b64decode(data), np.uint8)
        return cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1]


@pytest.fixture
def open_page(chromium, server):
    """Open the page in a window of its own; at the end nothing may have gone wrong in any."""
    contexts, wrong, asked = [], [], []

    def open_page(**options):
        context = chromium.new_context(viewport=WINDOW, **options)
        contexts.append(context)
        tab = context.new_page()
        tab.set_default_timeout(30_000)
        tab.on("request", lambda request: asked.append(request.url))
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        tab.on("console", lambda m: m.type == "error" and wrong.append(m.text))
        tab.goto(server.address)
        tab.wait_for_selector("body[data-ready]")
        tab.wait_for_selector("#warped[data-revision], #warped.stale", state="attached")
        return Page(tab, server)

    yield open_page
    for context in contexts:
        context.close()
    refused = "Failed to load resource: the server responded with a status of 409"
    assert [text for text in wrong if not text.startswith(refused)] == []
    own = (server.address, f"blob:{server.address.rpartition(server.token)[0][:-1]}", "data:")
    assert [url for url in asked if not url.startswith(own)] == []


@pytest.fixture
def page(open_page):
    return open_page()


def test_both_frames_and_all_proposals_are_shown(page):
    for kind, key in (("closed", "1"), ("open", "2")):
        page.press(key)
        tab = page.tab.locator(f"#tab-{kind}")
        assert tab.get_attribute("aria-selected") == "true"
        assert tab.inner_text().endswith("38")
        for side, shown in zip("ab", shown_frames()[kind], strict=True):
            assert page.tab.locator(f"#picture-{side} .point").count() == 38
            assert f"{shown.clip}, frame {shown.frame}" in page.tab.inner_text(f"#head-{side}")
        assert page.tab.locator("#list li").all_inner_texts() == list(NAMES)


def test_markers_lie_on_their_points(page):
    for side, at in zip("ab", page.points()["chin"], strict=True):
        box = page.tab.locator(f"#picture-{side} .point[aria-label^='chin,'] .ring").bounding_box()
        middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        np.testing.assert_allclose(middle, page.screen(side, at), atol=0.6)


def test_dragging_moves_a_point_in_one_picture(page):
    before = page.points()
    (x, y), b = before["nose_3"]
    page.drag("a", (x, y), (x + 9, y - 6))
    moved, unmoved = page.points()["nose_3"]
    np.testing.assert_allclose(moved, (x + 9, y - 6), atol=0.1)
    assert unmoved == b
    assert {**page.points(), "nose_3": before["nose_3"]} == before
    assert page.selected() == "nose_3"
    page.click("#undo")  # a whole drag at once
    assert page.points() == before
    page.click("#redo")
    assert page.points()["nose_3"][0] == moved


def test_a_point_cannot_leave_its_picture(page):
    page.select("jaw_5")
    page.press(*["Control+ArrowDown"] * 12)
    height = shown_frames()["closed"][0].picture.shape[0]
    assert page.points()["jaw_5"][0][1] == height - 1


def test_keys_go_through_the_points_and_move_them(page):
    page.tab.focus("#picture-a")
    page.press("]", "]")
    assert page.selected() == "nose_2"
    page.press("[", "[", "]", "]")
    assert page.selected() == "nose_2"
    (x, y), b = page.points()["nose_2"]
    page.press("ArrowRight", "ArrowRight", "ArrowUp", "Shift+ArrowDown", "Control+ArrowLeft")
    assert page.points()["nose_2"] == ([x + 2 - 8, y - 1 + 0.25], b)
    page.press("x", "ArrowLeft")
    assert page.points()["nose_2"] == ([x - 6, y - 0.75], [b[0] - 1, b[1]])


def test_tab_goes_from_picture_to_picture(page):
    page.tab.focus("#picture-a")
    page.press("]", "Tab", "Tab")
    assert page.tab.evaluate("document.activeElement.id") == "picture-b"
    (a, b), name = page.points()["nose_1"], page.selected()
    page.press("ArrowDown")
    assert page.points()[name] == (a, [b[0], b[1] + 1])


def test_undo_and_redo_by_keys(page):
    before = page.points()
    page.press("]", "Delete", "]", "Delete")
    after = page.points()
    assert len(after) == 36
    page.press("u", "Control+z")
    assert page.points() == before
    page.press("r", "Control+Shift+Z")
    assert page.points() == after
    page.press("u")
    page.press("]", "ArrowRight")  # another change: nothing to redo
    assert page.tab.is_disabled("#redo")


def test_adding_by_clicks(page):
    points = page.points()
    places = np.mean([points["jaw_3"], points["cheek_3"]], axis=0)  # free, in A and in B
    page.click("#add")
    page.click_at("a", places[0])
    assert "point 'extra_1' is unpaired: only in A, not in B" in page.messages()
    assert page.tab.locator("#list li.unpaired .note").inner_text() == "only in A"
    page.click_at("b", places[1])
    page.press("Escape")
    np.testing.assert_allclose(page.points()["extra_1"], places, atol=0.1)
    assert "unpaired" not in page.messages()
    page.click_at("a", np.mean([points["jaw_7"][0], points["cheek_4"][0]], axis=0))
    assert len(page.points()) == 39  # adding has ended


def test_adding_by_keys_pairs_where_the_others_suggest(page):
    page.tab.focus("#picture-b")
    page.press("n")
    assert page.points()["extra_1"][0] is None
    page.press("ArrowDown", "p")
    a, b = page.points()["extra_1"]
    mouths = [shown.mouth for shown in shown_frames()["closed"]]
    units = [
        (np.array(at) - mouth[:2]) / mouth[2] for at, mouth in zip((a, b), mouths, strict=True)
    ]
    np.testing.assert_allclose(units[0], units[1], atol=0.15)


def test_pairing_joins_two_unpaired_points(page):
    page.select("jaw_5")
    page.click("#unpair")  # in A
    page.tab.focus("#picture-a")
    page.press("n")
    added = page.points()["extra_1"][0]
    old = page.points()["jaw_5"]
    assert old[0] is None
    page.press("p")
    assert page.points()["extra_1"] == (added, old[1])
    assert "jaw_5" not in page.points()
    assert page.tab.is_disabled("#pair")


def test_deleting_in_both_pictures_or_in_one(page):
    page.select("chin")
    page.press("Delete")
    assert "chin" not in page.points()
    page.select("cheek_1")
    page.press("x", "Shift+Delete")
    assert page.points()["cheek_1"][0] is not None
    assert page.points()["cheek_1"][1] is None
    page.press("x", "Shift+Delete")  # now it is in neither
    assert "cheek_1" not in page.points()


@pytest.mark.parametrize(("presses", "count"), [(0, 1), (1, 9), (2, 38)])
def test_a_group_or_all_points_move_together(page, presses, count):
    before = page.points()
    page.select("jaw_2")
    page.press(*["m"] * presses, "ArrowRight")
    after = page.points()
    changed = {name for name in before if after[name] != before[name]}
    assert len(changed) == count
    assert all(name.startswith("jaw") for name in changed) == (count < 38)
    for name in changed:
        np.testing.assert_allclose(np.subtract(after[name][0], before[name][0]), (1, 0), atol=1e-9)
        assert after[name][1] == before[name][1]


def test_zoom_and_pan_change_the_view_alone(page):
    before, scales = page.points(), [page.scale(side) for side in "ab"]
    page.press("+", "+")
    assert all(page.scale(side) > 1.5 * old for side, old in zip("ab", scales, strict=True))
    page.press("-", "-")
    np.testing.assert_allclose([page.scale(side) for side in "ab"], scales, rtol=1e-6)
    place = np.array((70.0, 90.0))
    at = page.screen("a", place)
    page.tab.mouse.move(*at)
    page.tab.mouse.wheel(0, -300)
    while page.scale("a") < 1.5 * scales[0]:  # the browser takes its time with the wheel
        page.tab.wait_for_timeout(20)
    np.testing.assert_allclose(page.screen("a", place), at, atol=1.5)  # what is under the pointer
    page.tab.mouse.move(*page.screen("b", (30, 150)))
    page.tab.mouse.down()
    page.tab.mouse.move(*page.screen("b", (50, 140)), steps=3)
    page.tab.mouse.up()
    page.press("Escape", "ArrowRight")
    page.press("0", "w")
    assert page.points() == before
    assert page.session.describe()["revision"] == 0


def test_a_point_moved_by_keys_stays_in_view(page):
    page.select("outer_lip_1")
    page.press(*["+"] * 6, *["Control+ArrowDown"] * 3)
    x, y = page.screen("a", page.points()["outer_lip_1"][0])
    box = page.tab.locator("#picture-a").bounding_box()
    assert box["x"] < x < box["x"] + box["width"]
    assert box["y"] < y < box["y"] + box["height"]


def test_warped_picture_follows_the_points(page):
    picture = shown_frames()["closed"][0].picture
    np.testing.assert_array_equal(page.warped(), warped_onto(page.session.pair("closed"), picture))
    before = page.warped()
    page.select("outer_lip_4")
    page.press("Control+ArrowDown")
    after = page.warped()
    np.testing.assert_array_equal(after, warped_onto(page.session.pair("closed"), picture))
    assert np.abs(after.astype(float) - before).max() > 20
    page.press("h")
    overlay = page.tab.locator("#picture-b image").nth(1)
    assert overlay.get_attribute("opacity") == "1"
    assert overlay.get_attribute("href") == page.tab.locator("#warped image").first.get_attribute(
        "href"
    )


def test_fold_over_is_a_warning_that_goes_away(page):
    assert "folds" not in page.messages()
    page.select("outer_lip_4")
    page.press(*["Control+ArrowUp"] * 3)
    assert "folds over near" in page.messages()
    assert page.tab.locator("#list li.folded").count() > 0
    page.press("u")
    assert "folds" not in page.messages()


def test_impossible_points_are_named_and_not_saved(page, tmp_path):
    page.select("cheek_2")
    page.click("#unpair")
    assert page.tab.locator("#warped.stale").count() == 1
    for button in ("#save", "#finish"):
        page.click(button)
        page.tab.wait_for_selector("#messages p:has-text('not saved')")
        assert "'cheek_2' is unpaired" in page.messages()
    assert not (tmp_path / "ann-ben.json").exists()
    assert not page.server.finished.is_set()


def test_unsaved_changes_survive_a_reload(page):
    page.select("chin")
    page.press("ArrowDown", "2")
    page.select("nose_1")
    page.press("Delete")
    before = page.points(), page.points("open")
    page.tab.reload()
    page.tab.wait_for_selector("body[data-ready]")
    assert (page.points(), page.points("open")) == before
    assert page.tab.inner_text("#saved") == "Not saved yet"
    page.press("2")
    assert page.tab.locator("#picture-a .point").count() == 37
    page.press("1")
    page.select("chin")
    assert float(page.tab.input_value("#ay")) == before[0]["chin"][0][1]


def test_save_and_save_and_finish(page, tmp_path):
    page.select("chin")
    page.press("ArrowRight", "s")
    page.tab.wait_for_selector("#saved.saved")
    out = tmp_path / "ann-ben.json"
    chin = list(NAMES).index("chin")
    assert read_points(out)[0].points_a[chin].tolist() == page.points()["chin"][0]
    assert not page.server.finished.is_set()
    page.press("ArrowRight")
    assert page.tab.inner_text("#saved") == "Not saved yet"
    page.click("#finish")
    page.tab.wait_for_selector("#done[open]")
    assert str(out) in page.tab.inner_text("#done")
    assert page.server.finished.wait(20)
    assert read_points(out)[0].points_a[chin].tolist() == page.points()["chin"][0]


def test_a_saved_file_is_opened_again(chromium, server, tmp_path, open_page):
    page = open_page()
    page.press("2")
    page.select("jaw_1")
    page.press("Delete", "s")
    page.tab.wait_for_selector("#saved.saved")
    with serving(Session(tmp_path / "ann-ben.json", shown_frames())) as again:
        tab = chromium.new_page(viewport=WINDOW)
        tab.goto(again.address)
        tab.wait_for_selector("body[data-ready]")
        assert tab.inner_text("#saved") == "All saved"
        assert tab.locator("#tab-open .count").inner_text() == "37"
        tab.close()


def test_the_proposals_can_be_had_again(page):
    before = page.points()
    page.select("chin")
    page.press("Delete")
    page.select("nose_1")
    page.press("ArrowDown")
    page.click("#reset")
    assert page.points() == before
    page.press("u")
    assert "chin" not in page.points()


def test_a_point_can_be_typed(page):
    page.select("cheek_4")
    page.tab.fill("#bx", "101.5")
    page.tab.fill("#by", "9999")
    page.tab.fill("#name", "left cheek")
    page.tab.press("#name", "Enter")
    page.tab.press("#name", "Tab")
    page.settle()
    height = shown_frames()["closed"][1].picture.shape[0]
    assert page.points()["left cheek"][1] == [101.5, height - 1]
    assert "cheek_4" not in page.points()


def test_two_points_of_one_name_are_a_problem(page):
    page.select("cheek_4")
    page.tab.fill("#name", "cheek_3")
    page.tab.press("#name", "Tab")
    page.settle()
    assert "2 points are named 'cheek_3'" in page.messages()


def test_everything_from_the_keyboard_alone(page, tmp_path):
    """A whole session: correct a point, add one, pair it, look at the open pair, save, finish."""
    page.press("Tab")
    for _ in range(40):
        if page.tab.evaluate("document.activeElement.id") == "picture-a":
            break
        page.press("Tab")
    page.press("]", "ArrowRight", "Escape", "n", "ArrowUp", "p", "2", "]", "Delete", "s")
    page.tab.wait_for_selector("#saved.saved")
    closed, opened = read_points(tmp_path / "ann-ben.json")
    assert (len(closed.names), len(opened.names)) == (39, 37)
    while page.tab.evaluate("document.activeElement.id") != "finish":
        page.press("Shift+Tab")
    page.press("Enter")
    page.tab.wait_for_selector("#done[open]")
    assert page.server.finished.wait(20)


def test_help_opens_and_closes_by_key(page):
    page.press("?")
    assert page.tab.locator("#help[open]").count() == 1
    page.press("]")  # means nothing behind the help
    assert page.selected() is None
    page.press("Escape")
    assert page.tab.locator("#help[open]").count() == 0


def test_every_control_has_a_name_and_shows_its_focus(page):
    unnamed = page.tab.evaluate(
        """() => [...document.querySelectorAll('button, input, [tabindex="0"], [role]')]
            .filter(e => e.checkVisibility() && !(e.innerText?.trim() || e.ariaLabel
                || e.labels?.length || e.getAttribute('aria-labelledby') || e.role === 'status'))
            .map(e => e.outerHTML)"""
    )
    assert unnamed == []
    seen = []
    page.press("]")
    for _ in range(60):
        page.press("Tab")
        shown = page.tab.evaluate(
            """() => {
                const e = document.activeElement;
                const drawn = e.matches('.segments input') ? e.nextElementSibling : e;
                return [e.id || e.value || e.tagName, getComputedStyle(drawn).outlineStyle];
            }"""
        )
        if shown[0] in {name for name, _ in seen} or shown[0] == "BODY":
            break
        seen.append(shown)
    names = {name for name, _ in seen}
    assert {"picture-a", "picture-b", "add", "finish", "mix", "list", "ax", "name"} <= names
    assert [name for name, outline in seen if outline == "none"] == []


def test_it_fits_a_small_screen(page):
    assert page.tab.evaluate(
        "[document.documentElement.scrollWidth, document.documentElement.scrollHeight]"
    ) == [WINDOW["width"], WINDOW["height"]]
    for side in "ab":
        box = page.tab.locator(f"#picture-{side}").bounding_box()
        assert box["width"] > 400
        assert box["height"] > 400


@pytest.mark.parametrize(("scheme", "dark"), [("light", False), ("dark", True)])
def test_it_is_light_or_dark_as_the_person_likes(open_page, scheme, dark):
    tab = open_page(color_scheme=scheme).tab
    ground, text = tab.evaluate(
        """() => ['backgroundColor', 'color'].map(key =>
            getComputedStyle(document.body)[key].match(/\\d+/g).slice(0, 3).map(Number))"""
    )
    assert (np.mean(ground) < np.mean(text)) == dark
    assert abs(np.mean(ground) - np.mean(text)) > 150


def test_an_older_window_is_told_to_reload(open_page):
    first, second = open_page(), open_page()
    first.select("chin")
    first.press("ArrowDown")
    second.select("nose_1")
    second.press("ArrowDown")
    assert "changed in another window; reload this page" in second.messages()
    assert second.points() == first.points()
    second.tab.reload()
    second.tab.wait_for_selector("body[data-ready]")
    second.select("nose_1")
    second.press("ArrowDown")
    assert "reload" not in second.messages()


def test_it_says_when_the_command_has_ended(chromium, tmp_path):
    with serving(Session(tmp_path / "points.json", shown_frames())) as server:
        tab = chromium.new_page(viewport=WINDOW)
        tab.goto(server.address)
        tab.wait_for_selector("body[data-ready]")
    tab.keyboard.press("]")
    tab.keyboard.press("ArrowDown")
    tab.wait_for_selector("#messages p:has-text('no longer running')")
    tab.close()
