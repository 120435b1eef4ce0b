"""Names, titles and errors that are markup: a page that takes them for such runs the script in them.

Each sets `window.ran` where it is obeyed.
"""

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
