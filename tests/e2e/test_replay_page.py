"""The replay page in a real browser: it plays, scrubs, draws, tells what is under the pointer.

Wants Chromium: `make browser` installs it.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Error, Page, expect, sync_playwright

from liir_common.replay.load import load_checkpoint
from liir_common.replay.record import Recording, record
from liir_common.replay.write import write
from tests.replays import publish

NAMES = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    installed = next(filter(None, map(shutil.which, NAMES)), None)
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=installed)
        except Error as error:
            pytest.fail(f"this test wants Chromium, which `make browser` installs: {error.message}")
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    checkpoint = publish(tmp_path_factory.mktemp("liir"))
    return record(*load_checkpoint(checkpoint), seed=5, sampled=True)


@pytest.fixture(scope="module")
def file(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "battle.html"
    write(recording, path)
    return path


class Visit:
    """An open page, and whatever it complained about or asked the network for."""

    def __init__(self, browser: Browser, file: Path, **context: Any) -> None:
        self.page: Page = browser.new_page(**{"viewport": {"width": 1200, "height": 900}} | context)
        self.page.set_default_timeout(15_000)
        self.complaints: list[str] = []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.complaints.append(request.url))
        self.page.goto(file.as_uri())
        assert self.complaints == [file.as_uri()]
        self.complaints.clear()

    def pixels(self, canvas: str) -> str:
        """Everything on a canvas, as text."""
        return str(self.page.evaluate("id => document.getElementById(id).toDataURL()", canvas))

    def point_at(self, unit: int) -> None:
        """Move the pointer to where a unit is now."""
        place = f"(([x, y]) => [toX(x), toY(y)])(between({unit}).place)"
        x, y = self.page.evaluate(place)
        self.page.hover("#battle", position={"x": x, "y": y}, force=True)


@pytest.fixture
def visit(browser: Browser, file: Path) -> Iterator[Visit]:
    visit = Visit(browser, file)
    yield visit
    assert visit.complaints == []
    visit.page.close()


def at(step: int, recording: Recording) -> str:
    return f"{step} of {recording.trajectory.length}"


def test_it_plays_to_the_end_and_again(visit: Visit, recording: Recording) -> None:
    page, length = visit.page, recording.trajectory.length
    start = visit.pixels("battle")
    expect(page.locator("#clock")).to_have_text(at(0, recording))
    page.keyboard.press("ArrowUp")
    page.keyboard.press("ArrowUp")
    expect(page.locator("#speed")).to_have_value("4")
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    expect(page.locator("#clock")).to_have_text(at(length, recording), timeout=30_000)
    expect(page.get_by_role("button", name="Play")).to_be_visible()
    assert visit.pixels("battle") != start
    page.get_by_role("button", name="Play").click()
    page.get_by_role("button", name="Pause").click()
    assert page.evaluate("player.now") < length / 2, "playing from the end begins anew"
    before = page.evaluate("player.now")
    page.wait_for_timeout(200)
    assert page.evaluate("player.now") == before, "paused"


def test_it_scrubs_with_keys_and_slider(visit: Visit, recording: Recording) -> None:
    page, clock, length = visit.page, visit.page.locator("#clock"), recording.trajectory.length
    curve = visit.pixels("intrinsic")
    for key, step in (
        ("End", length),
        ("ArrowLeft", length - 1),
        ("Home", 0),
        ("ArrowLeft", 0),
        ("ArrowRight", 1),
    ):
        page.keyboard.press(key)
        expect(clock).to_have_text(at(step, recording))
    assert visit.pixels("intrinsic") != curve, "the cursor moved"
    page.get_by_role("slider", name="Step").fill("3.5")
    expect(clock).to_have_text(at(3, recording))
    page.keyboard.press("ArrowLeft")
    expect(clock).to_have_text(at(3, recording))
    assert page.evaluate("player.now") == 3, "back to the beginning of the step"
    page.get_by_role("button", name="One step forward").click()
    expect(clock).to_have_text(at(4, recording))


def test_the_pointer_asks_a_unit(visit: Visit, recording: Recording) -> None:
    page, t = visit.page, 4
    assert recording.intrinsic is not None
    page.evaluate(f"seek({t})")
    for i in (1, 2):
        visit.point_at(i)
        unit, action = recording.frames[t][i], recording.trajectory.actions[t, i]
        expect(page.locator("#unit")).to_have_value(str(i))
        expect(page.locator("#numbers")).to_contain_text(f"{unit['health']:.1f} of {unit['health_max']:.0f}")
        rows = page.locator("#actions tr").filter(has=page.locator("td"))
        expect(rows).to_have_count(int(recording.trajectory.mask[t, i].sum()))
        taken = page.locator("#actions tr.taken")
        expect(taken).to_contain_text(f"{100 * recording.probabilities[t, i, action]:.1f} %")
        expect(taken).to_contain_text(f"{recording.intrinsic[t, i, action]:.2f}")
    enemy = len(recording.frames[0]) - 1
    visit.point_at(enemy)
    expect(page.locator("#decision")).to_have_text("Scripted enemy: it has no policy.")
    page.mouse.move(2, 2)
    expect(page.locator("#unit")).to_have_value("0")
    visit.point_at(enemy)
    page.mouse.down()
    page.mouse.up()
    page.mouse.move(2, 2)
    expect(page.locator("#unit")).to_have_value(str(enemy))
    page.locator("#unit").select_option("3")
    expect(page.locator("#decision")).to_contain_text(f"Decision at step {t}")


def test_names_are_text(visit: Visit, recording: Recording) -> None:
    expect(visit.page.locator("#about")).to_contain_text("</script")
    assert visit.page.locator("b", has_text="run").count() == 0


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_it_is_sharp_and_fits_narrow_screens_in_both_schemes(
    browser: Browser, file: Path, scheme: str
) -> None:
    visit = Visit(
        browser, file, color_scheme=scheme, device_scale_factor=2, viewport={"width": 360, "height": 700}
    )
    canvas, fits = visit.page.evaluate(
        "[battle.width / battle.clientWidth, document.documentElement.scrollWidth <= innerWidth]"
    )
    assert canvas == pytest.approx(2, abs=0.01)
    assert fits, "a narrow screen scrolls sideways"
    ground = visit.page.evaluate("[...battle.getContext('2d').getImageData(20, 20, 1, 1).data].slice(0, 3)")
    assert (sum(ground) > 384) == (scheme == "light")
    assert visit.complaints == []
    visit.page.close()


def test_a_page_without_intrinsic_reward_says_so(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "battle.html"
    write(record(*load_checkpoint(publish(tmp_path, method="central_v"))), path)
    visit = Visit(browser, path)
    expect(visit.page.locator("#without")).to_have_text("None: central_v learns no intrinsic reward.")
    expect(visit.page.locator("#intrinsic")).to_be_hidden()
    expect(visit.page.locator("#actions th")).to_have_text(["action", "probability"])
    assert visit.complaints == []
    visit.page.close()
