"""Names, titles and errors that are markup stand in the viewer's page as text, and nothing in them runs."""

import pytest

pytest.importorskip("viser", reason="viser is not installed (the extra `viewer`)")
from ksim_rl.viewer.shown_text import MOST_LETTERS, as_html
from tests.viewer.chromium import TEXT, browsing, check_chromium, click, serving, until
from tests.viewer.markup import MARKUP, Page, figures, named_by_markup, shown


@pytest.mark.parametrize("markup", MARKUP.values(), ids=MARKUP)
def test_markup_is_text(markup):
    page = Page(f'<td title="{as_html(markup)}">{as_html(markup)}</td>')
    assert (page.tags, page.attributes) == ({"td"}, {"title"})
    assert page.text == shown(markup)


def test_a_text_without_end_is_cut():
    assert len(as_html("x" * 10**7)) == MOST_LETTERS


def test_the_panel_and_the_plots_hold_no_markup_of_a_run():
    names = len(MARKUP)
    assert figures(MARKUP.values()) == {
        "names": names,
        "obeyed": 0,
        "not_shown_as_text": 0,
        "in_markdown": 0,
    }


def test_a_real_browser_runs_nothing_of_a_run(tmp_path):
    check_chromium()

    def make_session():
        return named_by_markup("quadruped_velocity_flat", tuple(MARKUP.values()))

    def broken(_):
        raise RuntimeError("".join(MARKUP.values()))

    with serving(make_session, port=18330) as (viewer, session), browsing(tmp_path) as page:
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
        assert (
            page.execute_script("return document.querySelectorAll('img[src=x], iframe').length")
            == 0
        )
        assert page.execute_script("return window.ran === undefined")
