"""The page of `mmmgpu study serve` in a real browser: Chromium, driven by Playwright.

Without one these tests are skipped; where MMMGPU_REQUIRE_BROWSER=1 that is a failure.
"""

import shutil

import pytest
from studied import CONDITIONS, SENTENCES, write_clips

from mmmgpu.studies import read_study
from mmmgpu.study_creation import StudyOptions, create_study
from mmmgpu.study_server import StudyPage, serving
from mmmgpu.study_store import open_store
from mmmgpu.web_pages import LOOPBACK

WINDOW = {"width": 1280, "height": 720}
PHONE = {"width": 360, "height": 740}
N_PAIRS = 3  # with one attention check


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    clips = write_clips(tmp_path_factory.mktemp("clips"), sentences=SENTENCES[:2])
    options = StudyOptions(
        participants=1, pairs=N_PAIRS - 1, checks=1, seed=2, introduction="Look.\n<b>Choose</b>."
    )
    out = tmp_path_factory.mktemp("studies") / "page.study"
    create_study(clips, out, options=options)
    return out


class Site:
    """The study, served until it is stopped, and again at the same address when it is started."""

    def __init__(self, folder):
        self.study, self._folder = read_study(folder), folder
        self._store_block = open_store(folder, self.study)
        self.store = self._store_block.__enter__()
        self._port = 0
        self.start()

    def start(self):
        page = StudyPage(self._folder, self.study, self.store).application()
        self._serving = serving(page, host=LOOPBACK, port=self._port)
        self._port = self._serving.__enter__()

    def stop(self):
        self._serving.__exit__(None, None, None)

    def close(self):
        self.stop()
        self._store_block.__exit__(None, None, None)

    @property
    def origin(self):
        return f"http://{LOOPBACK}:{self._port}/"

    @property
    def link(self):
        return f"{self.origin}{self.study.participants[0].token}/"

    def choices(self):
        return [answer.choice for answer in self.store.answers()]


@pytest.fixture
def site(folder, tmp_path):
    """A study without answers."""
    site = Site(shutil.copytree(folder, tmp_path / "site.study"))
    yield site
    site.close()


class Visit:
    """The open page."""

    def __init__(self, tab, site):
        self.tab, self.site = tab, site

    def screen(self, name):
        self.tab.wait_for_selector(f"body[data-screen={name}]")

    def begin(self):
        self.screen("intro")
        self.tab.click("#begin")
        self.shown(self.site.store.count(1) + 1)

    def shown(self, pair):
        self.tab.wait_for_selector(f"body[data-pair='{pair}']")

    def watch(self):
        """Wait until both clips have played."""
        self.tab.wait_for_selector("#choices:not(:disabled)")

    def choose(self, choice):
        self.tab.locator(f"label:has(input[value={choice}])").click()

    def answer(self, choice):
        self.watch()
        self.choose(choice)
        self.tab.click("#confirm")

    def slow_down(self, side):
        """Play the clips of one side 16 times slower, those that come later too."""
        self._rate(side, 1 / 16)

    def speed_up(self, side):
        self._rate(side, 1)

    def _rate(self, side, rate):
        clip = self.tab.locator(f"figure[data-side={side}] video")
        clip.evaluate("(v, rate) => { v.defaultPlaybackRate = v.playbackRate = rate; }", rate)

    def message(self):
        return self.tab.inner_text("#message") if self.tab.is_visible("#message") else ""


@pytest.fixture
def visit(chromium, site):
    """Open the page in a window of its own; at the end nothing may have gone wrong in any."""
    contexts, wrong, asked = [], [], []

    def visit(context=None, *, viewport=WINDOW, **options):
        if context is None:
            context = chromium.new_context(viewport=viewport, **options)
            contexts.append(context)
        tab = context.new_page()
        tab.set_default_timeout(30_000)
        tab.on("request", lambda request: asked.append(request.url))
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        tab.on("console", lambda m: m.type == "error" and wrong.append(m.text))
        tab.goto(site.link)
        return Visit(tab, site)

    yield visit
    for context in contexts:
        context.close()
    expected = ("Failed to load resource: the server responded with a status of 4",)
    expected += ("Failed to load resource: net::ERR_",)
    assert [text for text in wrong if not text.startswith(expected)] == []
    assert [url for url in asked if not url.startswith((site.origin, "data:"))] == []
    names = [*CONDITIONS, "blue", "red", *(clip.name for clip in site.study.clips)]
    assert [url for url in asked if any(name in url for name in names)] == []


def test_a_whole_visit(visit, site):
    page = visit()
    page.screen("intro")
    assert page.tab.inner_text("#introduction") == "Look.\n<b>Choose</b>."
    assert page.tab.inner_text("#length") == "There are 3 pairs."
    page.begin()
    for pair, choice in enumerate(("left", "undecided", "right"), start=1):
        page.shown(pair)
        assert page.tab.inner_text("#place") == f"Pair {pair} of 3"
        page.answer(choice)
    page.screen("done")
    assert "All your answers are stored" in page.tab.inner_text("main")
    assert site.choices() == ["left", "undecided", "right"]
    assert page.message() == ""


def test_left_is_shown_on_the_left_and_counted_as_left(visit, site):
    page = visit()
    page.begin()
    boxes = [page.tab.locator(f"figure[data-side={s}]").bounding_box() for s in ("left", "right")]
    assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
    for side in ("left", "right"):
        address = page.tab.locator(f"figure[data-side={side}] video").get_attribute("src")
        assert address == f"pairs/1/{side}.mp4"
    page.answer("right")
    page.shown(2)
    assert site.choices() == ["right"]


def test_both_clips_are_played_before_one_can_choose(visit, site):
    page = visit()
    page.screen("intro")
    page.slow_down("left")
    page.begin()
    page.tab.wait_for_selector("figure[data-side=left][data-state=playing]")
    assert page.tab.inner_text("#hint") == "Watch A and B to the end, then choose."
    page.tab.keyboard.press("ArrowLeft")
    page.tab.keyboard.press("Enter")
    assert page.tab.locator("input:checked").count() == 0
    assert page.tab.evaluate("document.querySelector('#choices').disabled")
    assert page.tab.is_disabled("#confirm")
    page.slow_down("right")
    page.speed_up("left")
    page.tab.wait_for_selector("figure[data-side=right][data-state=playing]")
    assert page.tab.get_attribute("figure[data-side=left]", "data-state") == "seen"
    assert page.tab.inner_text("#hint") == "Watch B to the end, then choose."
    assert page.tab.evaluate("document.querySelector('#choices').disabled")
    page.speed_up("right")
    page.watch()
    assert page.tab.is_disabled("#confirm")
    page.choose("left")
    assert page.tab.is_enabled("#confirm")
    assert site.choices() == []


def test_clips_are_played_again(visit, site):
    page = visit()
    page.begin()
    page.watch()
    page.tab.evaluate(
        """() => {
            let played = 0;
            const clip = document.querySelector('figure[data-side=right] video');
            clip.addEventListener('ended', () => { document.body.dataset.played = ++played; });
        }"""
    )
    page.tab.click("text=Play B")
    page.tab.wait_for_selector("body[data-played='1']")
    page.tab.click("figure[data-side=right] video")
    page.tab.wait_for_selector("body[data-played='2']")
    page.tab.click("text=Play A")
    page.tab.wait_for_selector("figure[data-side=left][data-state=playing]")
    page.tab.keyboard.press("2")
    page.tab.wait_for_selector("body[data-played='3']")
    assert site.choices() == []


def test_the_keyboard_is_enough(visit, site):
    page = visit()
    page.screen("intro")
    page.tab.keyboard.press("Tab")
    page.tab.keyboard.press("Enter")
    for pair, key in enumerate(("ArrowRight", "ArrowDown", "ArrowLeft"), start=1):
        page.shown(pair)
        page.watch()
        page.tab.keyboard.press("ArrowLeft")
        page.tab.keyboard.press(key)
        page.tab.keyboard.press("Enter")
    page.screen("done")
    assert site.choices() == ["right", "undecided", "left"]


def test_who_reloads_goes_on_where_they_were(visit, site):
    page = visit()
    page.begin()
    page.answer("left")
    page.shown(2)
    page.watch()
    page.choose("right")
    page.tab.reload()
    page.screen("intro")
    assert page.tab.inner_text("#length") == "You have answered 1 of 3 pairs."
    assert page.tab.inner_text("#begin") == "Continue"
    page.begin()
    page.answer("undecided")
    page.shown(3)
    assert site.choices() == ["left", "undecided"]


def test_who_goes_back_goes_on_where_they_were(visit, site):
    page = visit()
    page.begin()
    page.answer("left")
    page.shown(2)
    page.tab.goto("data:text/html,elsewhere")
    page.tab.go_back()
    page.begin()
    assert page.tab.inner_text("#place") == "Pair 2 of 3"
    page.answer("right")
    page.shown(3)
    assert site.choices() == ["left", "right"]


def test_the_link_of_somebody_who_is_done(visit, site):
    for pair in (1, 2, 3):
        site.store.add(1, pair, "left")
    visit().screen("done")
    assert site.choices() == ["left"] * 3


def test_of_two_windows_the_first_answer_counts(visit, site):
    one = visit()
    two = visit(one.tab.context)
    for page in (one, two):
        page.tab.bring_to_front()
        page.begin()
        page.watch()
    one.choose("left")
    one.tab.click("#confirm")
    one.shown(2)
    two.choose("right")
    two.tab.click("#confirm")
    two.shown(2)
    line = "Not counted: pair 1 is answered already: the first answer counts."
    assert two.message() == line
    assert site.choices() == ["left"]


TWICE = {
    "click": "form.querySelector('#confirm').click(); form.querySelector('#confirm').click()",
    "submit": "form.requestSubmit(); form.requestSubmit()",  # as Enter does, without the button
}


@pytest.mark.parametrize("way", TWICE)
def test_a_double_click_is_one_answer(visit, site, way):
    page = visit()
    page.begin()
    page.watch()
    page.choose("left")
    sent = []
    page.tab.on("request", lambda r: sent.append(r.url) if r.method == "POST" else None)
    page.tab.evaluate(f"() => {{ const form = document.querySelector('#pair'); {TWICE[way]} }}")
    page.shown(2)
    page.watch()
    assert len(sent) == 1
    assert page.message() == ""
    assert site.choices() == ["left"]


def test_a_form_changed_by_hand_is_refused(visit, site):
    page = visit()
    page.begin()
    page.watch()
    page.choose("left")
    page.tab.evaluate("document.querySelector('input:checked').value = 'reality'")
    with page.tab.expect_console_message(lambda m: "400" in m.text):
        page.tab.click("#confirm")
    page.tab.wait_for_selector("#message:visible")
    line = "The answer was not taken: the answer must be one of left, undecided, right."
    assert page.message() == line
    assert site.choices() == []
    page.tab.evaluate("document.querySelector('input:checked').value = 'left'")
    page.tab.click("#confirm")
    page.shown(2)
    assert site.choices() == ["left"]


def test_an_answer_waits_for_a_server_that_was_away(visit, site):
    page = visit()
    page.begin()
    page.watch()
    page.choose("right")
    site.stop()
    page.tab.click("#confirm")
    page.tab.wait_for_selector("#message:visible")
    assert "Your answer is kept here and sent again" in page.message()
    assert page.tab.is_disabled("#confirm")
    assert site.choices() == []
    site.start()
    page.shown(2)
    assert site.choices() == ["right"]
    assert page.message() == ""


def test_a_page_waits_for_a_server_that_is_away(visit, site):
    page = visit()
    page.screen("intro")
    page.tab.route("**/state", lambda route: route.abort())
    page.tab.reload()
    page.tab.wait_for_selector("#message:visible")
    assert "cannot be reached" in page.message()
    page.tab.unroute("**/state")
    page.screen("intro")
    assert page.message() == ""


def test_a_clip_that_does_not_load_can_be_tried_again(visit, site):
    page = visit()
    page.screen("intro")
    page.tab.route("**/right.mp4", lambda route: route.abort())
    page.tab.click("#begin")
    page.tab.wait_for_selector("#again:visible")
    assert "could not be loaded" in page.message()
    assert page.tab.evaluate("document.querySelector('#choices').disabled")
    page.tab.unroute("**/right.mp4")
    page.tab.click("#again")
    page.answer("left")
    page.shown(2)
    assert site.choices() == ["left"]


@pytest.mark.parametrize("size", [PHONE, {"width": 740, "height": 360}], ids=["upright", "across"])
def test_a_phone_shows_all_at_once(visit, site, size):
    page = visit(viewport=size, is_mobile=True, has_touch=True)
    page.screen("intro")
    page.tab.tap("#begin")
    page.watch()
    for what in ("video", "figcaption button", "#choices span", "#confirm"):
        for box in (item.bounding_box() for item in page.tab.locator(what).all()):
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= size["width"]
            assert box["y"] + box["height"] <= size["height"]
            assert min(box["width"], box["height"]) >= 32
    page.tab.locator("#choices span").nth(2).tap()
    page.tab.tap("#confirm")
    page.shown(2)
    assert site.choices() == ["right"]


def test_a_wrong_link_is_said_in_one_line(visit, site):
    page = visit()
    page.screen("intro")
    with page.tab.expect_response(lambda r: r.status == 404):
        page.tab.goto(site.link.replace(site.study.participants[0].token, "nobody"))
    assert page.tab.inner_text("body").strip() == (
        "this address is not known here: use the whole link that you were given"
    )
