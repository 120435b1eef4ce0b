"""A real browser opens the viewer: the robot moves, sliders and keys command it, plots hold the present values.

With KSIM_RL_SCREENSHOTS=DIR it leaves its pictures there.
"""

import io
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.viewer.chromium import TEXT, WIDTH, browsing, check_chromium, click, serving, until
from tests.viewer.test_session import session_of

TASK = "quadruped_velocity_flat"
# What a widget with this label holds that fits the selector.
LABELLED = """
    const label = [...document.querySelectorAll('label')].find(l => l.textContent.trim() === arguments[0]);
    for (let at = label; at; at = at.parentElement) {
        const found = at.querySelector(arguments[1]);
        if (found) return found;
    }"""
CELLS = """
    return Object.fromEntries([...document.querySelectorAll('[data-value]')]
        .map(cell => [cell.dataset.value, Number(cell.textContent)]))"""
# Each chart that viser drew: its size, the last value of each curve, and how many pixels are coloured.
CHARTS = """
    return Object.values(window.__viserTestpoints?.uplots ?? {}).map(({chart}) => {
        const {width, height} = chart.ctx.canvas, rgba = chart.ctx.getImageData(0, 0, width, height).data;
        let coloured = 0;
        for (let i = 0; i < rgba.length; i += 4) coloured += rgba[i + 3] > 0 && Math.abs(rgba[i] - rgba[i + 2]) > 40;
        const last = chart.data.slice(1).map(values => values[values.length - 1]);
        return {width: chart.width, height: chart.height, coloured, last};
    })"""


@pytest.fixture(scope="module", autouse=True)
def needs_chromium():
    check_chromium()


@pytest.fixture(scope="module")
def served():
    def make_session():
        session = session_of(TASK, agent="random")
        session.title = TASK
        return session

    with serving(make_session, port=18080) as found:
        yield found


@pytest.fixture(scope="module")
def page(served, tmp_path_factory):
    with browsing(tmp_path_factory.mktemp("profile")) as driver:
        driver.get(f"{served[0].address}/?fixedDpr=0.4")
        until(lambda: "paused, " in driver.execute_script(TEXT), "the panel")
        yield driver


def step(page, session):
    """Click Step, and wait until the page shows it."""
    wanted = session.steps + 1
    click(page, "Step")
    until(lambda: f"step {wanted}" in page.execute_script(TEXT), f"step {wanted}")


def robot(page, name: str) -> np.ndarray:
    """Where the picture is dark: where the robot is, as nothing else is beside the panel and below the notice.

    Nowhere, while the browser is too busy to make a picture.
    """
    from selenium.common.exceptions import TimeoutException

    try:
        png = page.get_screenshot_as_png()
    except TimeoutException:
        return np.zeros(0, dtype=bool)
    if folder := os.environ.get("KSIM_RL_SCREENSHOTS"):
        Path(folder, f"{name}.png").write_bytes(png)
    seen = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
    return (seen[seen.shape[0] // 2 :, : WIDTH - 340] < 70).all(-1)


def test_the_robot_moves(served, page):
    _, session = served
    before = np.zeros(0)

    def stands() -> bool:
        nonlocal before
        last, before = before, robot(page, "paused")
        return before.sum() > 100 and np.array_equal(last, before)

    until(stands, "a robot that stands still")
    click(page, "Play")
    until(lambda: session.steps > 20, "steps")
    click(page, "Pause")
    until(lambda: not session.playing, "the pause")
    until(lambda: f"step {session.steps}" in page.execute_script(TEXT), "the last step")

    def moved() -> bool:
        now = robot(page, "later")
        return now.sum() > 100 and (now != before).sum() > 100

    until(moved, "a robot that stands otherwise")


def test_a_slider_commands_the_robot(served, page):
    from selenium.webdriver.common.keys import Keys

    _, session = served
    thumb = until(lambda: page.execute_script(LABELLED, "lin_vel_x", "[role=slider]"), "a slider")
    for _ in range(3):
        thumb.send_keys(Keys.ARROW_RIGHT)
    (name,) = session.commands
    wanted = lambda: session.ours.view.command_ranges[name]["lin_vel_x"].tolist()  # noqa: E731
    until(lambda: wanted() == pytest.approx([0.06, 0.06]), "the command of the slider")
    step(page, session)
    assert float(session.commands[name][0]) == pytest.approx(0.06)
    assert float(thumb.get_attribute("aria-valuenow")) == pytest.approx(0.06)


def test_plots_hold_the_present_values(served, page):
    _, session = served
    for _ in range(2):
        step(page, session)
    now = session.rewards

    def drawn() -> bool:
        charts = page.execute_script(CHARTS)
        return any(
            chart["last"] == pytest.approx(list(now.values())) and chart["coloured"] > 100
            for chart in charts
            if chart["width"] > 200 and chart["height"] > 100
        )

    until(drawn, "a chart of the reward terms")
    table = {name: pytest.approx(value, abs=1e-4) for name, value in now.items()}
    until(
        lambda: table.items() <= page.execute_script(CELLS).items(), "a table of the reward terms"
    )


def test_an_error_pauses_and_is_shown(served, page):
    _, session = served
    working = session.agent

    def broken(_):
        raise RuntimeError("the policy has no answer")

    session.ask(lambda: setattr(session, "agent", broken))
    click(page, "Play")
    until(
        lambda: "RuntimeError: the policy has no answer" in page.execute_script(TEXT), "the error"
    )
    assert not session.playing
    session.ask(lambda: setattr(session, "agent", working))
    step(page, session)
    until(
        lambda: "the policy has no answer" not in page.execute_script(TEXT), "an end of the error"
    )


def test_noise_is_switched_off(served, page):
    _, session = served
    box = until(
        lambda: page.execute_script(LABELLED, "noise", "input[type=checkbox]"), "a switch of noise"
    )
    assert any(group.enable_noise for group in session.ours.cfg.observations.values())
    page.execute_script("arguments[0].click()", box)
    until(lambda: session.built == 2, "another env")
    assert not any(group.enable_noise for group in session.ours.cfg.observations.values())
    step(page, session)
    until(lambda: robot(page, "calm").sum() > 100, "the robot of the other env")


def test_keys_and_gamepads_drive(served, page):
    """The keys are Chromium's; the gamepad is an object that says what a real one would."""
    from selenium.webdriver.common.action_chains import ActionChains

    viewer, session = served
    page.get(viewer.pad_address)
    until(lambda: "connected: " in page.execute_script(TEXT), "the page of keys")
    page.execute_script("document.getElementById('bar').focus()")
    (name,) = session.commands
    forward = lambda: session.ours.view.command_ranges[name]["lin_vel_x"].tolist()  # noqa: E731
    ActionChains(page).key_down("w").perform()
    until(lambda: forward() == [1.0, 1.0], "the command of a key")
    ActionChains(page).key_up("w").perform()
    until(lambda: forward() == [0.0, 0.0], "the end of the command")
    steps = session.steps
    ActionChains(page).send_keys("n").perform()
    until(lambda: session.steps == steps + 1, "a step")
    still_EL = session.ours.world.qvel_EL.clone()
    ActionChains(page).send_keys("f").perform()
    until(lambda: not session.ours.world.qvel_EL.equal(still_EL), "a push")
    ActionChains(page).send_keys("r").perform()
    until(lambda: session.ours.episode_step_E.tolist() == [0, 0], "a reset")
    ActionChains(page).send_keys(" ").perform()
    until(lambda: session.steps > steps + 5, "play")
    ActionChains(page).send_keys(" ").perform()
    until(lambda: not session.playing, "the pause")
    page.execute_script(
        "window.pad = {axes: [0, -0.5, 0, 0], buttons: Array.from({length: 17}, () => ({pressed: false}))};"
        "navigator.getGamepads = () => [window.pad]"
    )
    until(lambda: forward() == [0.5, 0.5], "the command of a stick")
    page.execute_script("window.pad.buttons[1].pressed = true")
    until(lambda: session.ours.episode_step_E.tolist() == [0, 0], "a reset by a button")
