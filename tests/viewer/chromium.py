"""A real browser for tests of the viewer: what it needs, how it starts, and how a session is served to it.

It needs Debian's packages chromium and chromium-driver; tests are skipped where they are missing, unless
KSIM_RL_NEEDS_CHROMIUM says that they have to be there.

A browser that draws without a graphics card needs seconds for what takes one a millisecond. So the window is small,
lights are plain, the session stands still unless a test lets it go, and each test waits for what it looks for.
"""

import contextlib
import os
import shutil
import threading
import time

import pytest

# How long a check waits before it fails. Nothing here takes a tenth of it on two idle cores.
PATIENCE_S = 180.0
WIDTH, HEIGHT = 760, 480
FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    f"--window-size={WIDTH},{HEIGHT}",
)
NEEDED = {
    "chromium": shutil.which("chromium") or shutil.which("google-chrome"),
    "chromedriver": shutil.which("chromedriver"),
}
TEXT = "return document.body.textContent"
BUTTON = "return [...document.querySelectorAll('button')].find(b => b.textContent.trim() === arguments[0])"


def check_chromium():
    """Skip where there is no browser, or fail where there has to be one."""
    missing = [name for name, path in NEEDED.items() if path is None]
    if missing and os.environ.get("KSIM_RL_NEEDS_CHROMIUM"):
        pytest.fail(f"{missing} are not installed, and KSIM_RL_NEEDS_CHROMIUM is set")
    if missing:
        pytest.skip(f"{missing} are not installed (Debian: chromium chromium-driver)")


@contextlib.contextmanager
def serving(make_session, *, port):
    """Serve a session, paused, from a thread that steps it, as `ksim-rl play --live` does; yield viewer and session."""
    from ksim_rl.viewer.browser import BrowserViewer

    ready, end, made = threading.Event(), threading.Event(), {}

    def run():
        try:
            session = make_session()
            session.play(False)
            made["viewer"] = viewer = BrowserViewer(port=port)
            # Reflections alone would take half a minute to prepare.
            viewer.server.scene.configure_environment_map(None)
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


@contextlib.contextmanager
def browsing(profile):
    """Start a browser with its profile in a folder, and yield its driver."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = NEEDED["chromium"]
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=Service(NEEDED["chromedriver"]))
    driver.command_executor.client_config.timeout = PATIENCE_S
    yield driver
    driver.quit()


def until(condition, what: str):
    """Wait for a condition, and return what it is."""
    deadline = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        if time.monotonic() > deadline:
            pytest.fail(f"not seen within {PATIENCE_S:.0f} s: {what}")
        time.sleep(0.1)
    return found


def click(page, text: str):
    """Click a button once it is there."""
    button = until(lambda: page.execute_script(BUTTON, text), f"a button {text!r}")
    page.execute_script("arguments[0].click()", button)
