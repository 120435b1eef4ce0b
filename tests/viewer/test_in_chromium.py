"""A real browser opens the viewer: the robot moves, a slider commands it, present values stand beside the plots.

It needs Debian's packages chromium and chromium-driver, and is skipped where they are missing, unless
KSIM_RL_NEEDS_CHROMIUM says that they have to be there. With KSIM_RL_SCREENSHOTS=DIR it leaves its pictures there.
"""

import io
import os
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.viewer.test_session import session_of

TASK = "quadruped_velocity_flat"
PATIENCE_S = 120.0
FLAGS = (
    *(
        "--headless=new",
        "--no-sandbox",
        "--no-first-run",
        "--disable-quic",
        "--disable-background-networking",
    ),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage", "--window-size=1000,720"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
NEEDED = {
    "chromium": shutil.which("chromium") or shutil.which("google-chrome"),
    "chromedriver": shutil.which("chromedriver"),
}


@pytest.fixture(scope="module", autouse=True)
def needs_chromium():
    missing = [name for name, path in NEEDED.items() if path is None]
    if missing and os.environ.get("KSIM_RL_NEEDS_CHROMIUM"):
        pytest.fail(f"{missing} are not installed, and KSIM_RL_NEEDS_CHROMIUM is set")
    if missing:
        pytest.skip(f"{missing} are not installed (Debian: chromium chromium-driver)")


@pytest.fixture(scope="module")
def served():
    """A session that a thread steps and serves, as `ksim-rl play --live` does."""
    from ksim_rl.viewer.browser import BrowserViewer

    ready, end, made = threading.Event(), threading.Event(), {}

    def run():
        try:
            session = session_of(TASK, agent="random")
            session.title = TASK
            made["viewer"] = viewer = BrowserViewer(port=18080)
            # What a graphics card draws in a millisecond takes seconds in software.
            viewer.server.scene.configure_default_lights(cast_shadow=False)
            viewer.open(session)
            made["session"] = session
        finally:
            ready.set()
        viewer.run(goes_on=lambda: not end.is_set())
        viewer.close()
        session.close()

    thread = threading.Thread(target=run)
    thread.start()
    ready.wait()
    yield made["viewer"], made["session"]
    end.set()
    thread.join()


@pytest.fixture(scope="module")
def page(served, tmp_path_factory):
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = NEEDED["chromium"]
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=Service(NEEDED["chromedriver"]))
    driver.command_executor.client_config.timeout = PATIENCE_S
    driver.get(f"{served[0].address}/?fixedDpr=0.4")
    until(lambda: "Pause" in driver.execute_script("return document.body.innerText"), "the panel")
    yield driver
    driver.quit()


def until(condition, what: str):
    deadline = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        if time.monotonic() > deadline:
            pytest.fail(f"not seen within {PATIENCE_S:.0f} s: {what}")
        time.sleep(0.2)
    return found


def click(page, text: str):
    script = (
        "return [...document.querySelectorAll('button')].filter(b => b.innerText.trim() === arguments[0])[0]"
    )
    page.execute_script("arguments[0].click()", until(lambda: page.execute_script(script, text), text))


def pause(page, session):
    click(page, "Pause")
    until(lambda: not session.playing, "the pause")
    until(
        lambda: f"step {session.steps}" in page.execute_script("return document.body.innerText"),
        "the last step",
    )


def picture(page, name: str) -> np.ndarray:
    """What the browser shows of the scene, once that stands still."""
    last = None
    for _ in range(40):
        png = page.get_screenshot_as_png()
        seen = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), dtype=np.int16)[60:, : 1000 * 6 // 10]
        if last is not None and np.array_equal(seen, last):
            break
        last = seen
    if folder := os.environ.get("KSIM_RL_SCREENSHOTS"):
        Path(folder, f"{name}.png").write_bytes(png)
    return seen


def test_the_robot_moves(served, page):
    _, session = served
    until(lambda: session.steps > 5, "steps")
    pause(page, session)
    before, step = picture(page, "paused"), session.steps
    assert np.array_equal(picture(page, "paused"), before)
    assert before.std() > 5.0  # something is drawn
    click(page, "Play")
    until(lambda: session.steps > step + 20, "more steps")
    pause(page, session)
    changed = np.abs(picture(page, "later") - before).max(-1) > 30
    assert changed.sum() > 200


def test_a_slider_commands_the_robot(served, page):
    from selenium.webdriver.common.keys import Keys

    _, session = served
    script = """
        const label = [...document.querySelectorAll('label')].filter(l => l.innerText.trim() === 'lin_vel_x')[0];
        for (let at = label; at; at = at.parentElement) {
            const thumb = at.querySelector('[role=slider]');
            if (thumb) return thumb;
        }"""
    thumb = until(lambda: page.execute_script(script), "the slider of lin_vel_x")
    for _ in range(3):
        thumb.send_keys(Keys.ARROW_RIGHT)
    (name,) = session.commands
    wanted = lambda: session.ours.view.command_ranges[name]["lin_vel_x"].tolist()  # noqa: E731
    until(lambda: wanted()[0] == wanted()[1] > 0.0, "the command of the slider")
    click(page, "Step")
    until(lambda: session.commands[name][0] == pytest.approx(wanted()[0]), "the commanded speed")
    assert float(thumb.get_attribute("aria-valuenow")) == pytest.approx(wanted()[0])


def test_a_plot_has_the_present_values(served, page):
    _, session = served
    tabs = (
        "return [...document.querySelectorAll('[role=tab]')].filter(t => t.innerText.trim() === 'Plots')[0]"
    )
    page.execute_script("arguments[0].click()", until(lambda: page.execute_script(tabs), "the tab of plots"))
    cells = (
        "return Object.fromEntries([...document.querySelectorAll('[data-value]')]"
        ".map(cell => [cell.dataset.value, cell.innerText]))"
    )
    until(lambda: session.rewards.keys() <= page.execute_script(cells).keys(), "the table of reward terms")
    term = next(iter(session.rewards))
    until(
        lambda: float(page.execute_script(cells)[term]) == pytest.approx(session.rewards[term], abs=1e-4),
        "the present value",
    )
    picture(page, "plots")


def test_an_error_pauses_and_is_shown(served, page):
    _, session = served

    def broken(_):
        raise RuntimeError("the policy has no answer")

    session.ask(lambda: setattr(session, "agent", broken))
    session.ask(session.play)
    until(lambda: session.error, "the error")
    tabs = (
        "return [...document.querySelectorAll('[role=tab]')].filter(t => t.innerText.trim() === 'Control')[0]"
    )
    page.execute_script("arguments[0].click()", page.execute_script(tabs))
    shown = lambda: page.execute_script("return document.body.innerText")  # noqa: E731
    until(lambda: "RuntimeError: the policy has no answer" in shown(), "the error in the panel")
    assert not session.playing
    picture(page, "error")
