"""Names, titles and errors that are markup: a page that takes them for such runs the script in them.

Each sets `window.ran` where it is obeyed. `figures` counts, without a browser, what panel and plots make of them.
"""

import dataclasses
from html.parser import HTMLParser

import viser

from ksim_rl import envs
from ksim_rl.viewer.panel import Panel
from ksim_rl.viewer.plots import Plots
from tests.viewer.test_session import session_of

RUN = "window.ran=1"
MARKUP = {
    "picture": f'<img src=x onerror="{RUN}">',
    "script": f"<script>{RUN}</script>",
    "drawing": f"<svg onload='{RUN}'></svg>",
    "end_of_the_cell": f'</td></tr></table><img src=x onerror="{RUN}">',
    "end_of_the_listing": f'</pre></code>\n```\n<img src=x onerror="{RUN}">',
    "end_of_the_attribute": f'" autofocus tabindex=0 onfocus="{RUN}" x="',
    "frame": f'<iframe srcdoc="<script>parent.{RUN}</script>"></iframe>',
    "escaped_once": f"&lt;img src=x onerror={RUN}&gt;",
    "markdown_link": f"[x](javascript:{RUN})",
    "markdown_picture_of_a_file": "![x](/etc/hostname)",
    "control_characters": f"\x1b[2J\x00\x9b\u202e<img src=x onerror={RUN}>",
}
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


def named_by_markup(task, markups):
    """A session whose rewards, observations, commands, title and note are markup."""
    cfg = envs.make_cfg(task)
    reward = next(iter(cfg.rewards.values()))
    groups = dict(cfg.observations)
    first = next(iter(groups))
    term = next(iter(groups[first].terms.values()))
    terms = {**groups[first].terms, **dict.fromkeys(markups, term)}
    groups[first] = dataclasses.replace(groups[first], terms=terms)
    commands = dict(cfg.commands)
    for command in list(cfg.commands.values())[:1]:
        commands |= dict.fromkeys(markups[:2], command)
    rewards = {**cfg.rewards, **dict.fromkeys(markups, reward)}
    session = session_of(task, rewards=rewards, observations=groups, commands=commands)
    session.title = " ".join(markups)
    session.note = markups[0]
    return session


def figures(markups):
    """Show a session with such names, and an error that has them too; count what a page would obey."""
    markups = tuple(markups)
    session = named_by_markup("cartpole_swingup", markups)
    server = viser.ViserServer(host="127.0.0.1", port=18320, verbose=False)
    gui = Gui(server.gui)
    panel = Panel(gui, session)
    plots = Plots(gui, server.gui.add_folder("Plots"), session)
    for _ in range(2):
        session.step_once()
        plots.take()
    session.error, session.trace = f"RuntimeError: {markups[0]}", "\n".join(markups)
    panel.show()
    plots.show()
    server.stop()
    session.close()
    pages = [Page(handle.content) for handle in gui.html]
    strange = [tag for page in pages for tag in page.tags - OURS]
    handlers = [name for page in pages for name in page.attributes if name.startswith("on")]
    text = "".join(page.text for page in pages)
    # In the title, as a reward, and in the error.
    unseen = [markup for markup in markups if text.count(shown(markup)) < 3]
    in_markdown = [
        content for content in gui.markdown if any(markup in content for markup in markups)
    ]
    return {
        "names": len(markups),
        "obeyed": len(strange) + len(handlers),
        "not_shown_as_text": len(unseen),
        "in_markdown": len(in_markdown),
    }
