"""Names, titles and errors that are markup stand in the viewer's page as text, and nothing in them runs."""

import dataclasses
from html.parser import HTMLParser

import pytest

pytest.importorskip("viser", reason="viser is not installed (the extra `viewer`)")
import viser

from ksim_rl import envs
from ksim_rl.viewer.panel import Panel
from ksim_rl.viewer.plots import Plots
from ksim_rl.viewer.shown_text import MOST_LETTERS, as_html
from tests.viewer.chromium import TEXT, browsing, check_chromium, click, serving, until
from tests.viewer.markup import MARKUP
from tests.viewer.test_session import session_of

SMALL, LARGE = "cartpole_swingup", "quadruped_velocity_flat"
OURS = {"p", "b", "pre", "table", "tr", "td"}


class Page(HTMLParser):
    """Keeps the tags of HTML with their attributes, and its text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.text = set(), set(), ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data):
        self.text += data


class Gui:
    """viser's widgets, with what they were given as HTML and as markdown."""

    def __init__(self, gui):
        self._gui, self.html, self.markdown = gui, [], []

    def __getattr__(self, name):
        return getattr(self._gui, name)

    def add_html(self, *given, **how):
        self.html.append(self._gui.add_html(*given, **how))
        return self.html[-1]

    def add_markdown(self, content, **how):
        self.markdown.append(content)
        return self._gui.add_markdown(content, **how)


def shown(text):
    """The text as a page has it: what cannot be printed is a space."""
    return "".join(letter if letter == "\n" or letter.isprintable() else " " for letter in text)


def named_by_markup(task, **changes):
    """A session whose rewards, observations, title, note and error are markup."""
    cfg = envs.make_cfg(task)
    kept = next(iter(cfg.rewards.values()))
    groups = dict(cfg.observations)
    first = next(iter(groups))
    term = next(iter(groups[first].terms.values()))
    terms = dict.fromkeys(MARKUP.values(), term)
    groups[first] = dataclasses.replace(groups[first], terms={**groups[first].terms, **terms})
    commands = dict(cfg.commands)
    for name, command in list(cfg.commands.items())[:1]:
        commands |= {MARKUP["picture"]: command, MARKUP["script"]: command}
    session = session_of(
        task,
        rewards={**cfg.rewards, **dict.fromkeys(MARKUP.values(), kept)},
        observations=groups,
        commands=commands,
        **changes,
    )
    session.title = " ".join(MARKUP.values())
    session.note = MARKUP["picture"]
    return session


@pytest.mark.parametrize("markup", MARKUP.values(), ids=MARKUP)
def test_markup_is_text(markup):
    page = Page(f'<td title="{as_html(markup)}">{as_html(markup)}</td>')
    assert (page.tags, page.attributes) == ({"td"}, {"title"})
    assert page.text == shown(markup)


def test_a_text_without_end_is_cut():
    assert len(as_html("x" * 10**7)) == MOST_LETTERS


def test_the_panel_and_the_plots_hold_no_markup_of_a_run():
    session = named_by_markup(SMALL)
    server = viser.ViserServer(host="127.0.0.1", port=18320, verbose=False)
    gui = Gui(server.gui)
    panel = Panel(gui, session)
    plots = Plots(gui, server.gui.add_folder("Plots"), session)
    for _ in range(2):
        session.step_once()
        plots.take()
    session.error, session.trace = "RuntimeError: " + MARKUP["end_of_the_listing"], MARKUP["script"]
    panel.show()
    plots.show()
    server.stop()
    session.close()
    pages = [Page(handle.content) for handle in gui.html]
    assert set().union(*(page.tags for page in pages)) <= OURS
    assert not [name for page in pages for name in page.attributes if name.startswith("on")]
    text = "".join(page.text for page in pages)
    assert all(text.count(shown(markup)) >= 2 for markup in MARKUP.values())  # in the title, and as a reward
    assert not [content for content in gui.markdown for markup in MARKUP.values() if markup in content]


def test_a_real_browser_runs_nothing_of_a_run(tmp_path):
    check_chromium()

    def broken(_):
        raise RuntimeError("".join(MARKUP.values()))

    with serving(lambda: named_by_markup(LARGE), port=18330) as (viewer, session), browsing(tmp_path) as page:
        page.get(f"{viewer.address}/?fixedDpr=0.4")
        until(lambda: "paused, " in page.execute_script(TEXT), "the panel")
        for wanted in (1, 2):
            click(page, "Step")
            until(lambda wanted=wanted: f"step {wanted}" in page.execute_script(TEXT), "a step")
        rewards = "return document.querySelectorAll('[data-value]').length"
        until(lambda: page.execute_script(rewards) >= len(MARKUP), "a table of the reward terms")
        assert all(shown(markup) in page.execute_script(TEXT) for markup in MARKUP.values())
        session.ask(lambda: setattr(session, "agent", broken))
        click(page, "Step")
        until(lambda: "Paused by an error" in page.execute_script(TEXT), "the error")
        assert page.execute_script("return document.querySelectorAll('img[src=x], iframe').length") == 0
        assert page.execute_script("return window.ran === undefined")
