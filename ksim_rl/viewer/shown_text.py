"""Text of a run is shown in a page as the text that it is: a name, a title or an error may hold markup.

viser puts HTML, and the HTML inside of markdown, into its page as it stands, scripts included, and reads files that
markdown names as pictures. So nothing of a run goes into its markdown, and into its HTML only through `as_html`.
"""

import html

# A page is slow long before; errors with their traces are shorter.
MOST_LETTERS = 20_000


def as_html(text: str) -> str:
    """Return HTML that shows `text` as it stands, letter by letter; control characters become spaces."""
    letters = []
    for letter in text[:MOST_LETTERS]:
        is_shown = letter == "\n" or letter.isprintable()
        letters.append(letter if is_shown else " ")
    return html.escape("".join(letters))


def paragraph(markup: str) -> str:
    """Return markup as a paragraph that is indented as the widgets beside it are."""
    return f'<p style="margin:0.3em 0;padding:0 1em;font-size:0.9em">{markup}</p>'
