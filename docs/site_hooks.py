"""MkDocs calls this module: it adds what pages link to outside of docs/, and the pages of reference that
its navigation names.

README, CONTRIBUTING and CHANGELOG become pages; a source file or folder that any page links to becomes one as well, so
that each link which works in the repository works on the site; pictures of benchmarks come along. A link to what does
not exist is a warning, and so an error, since the site is built with `strict`.
"""

import importlib
import json
import logging
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
_LINK = re.compile(r"(\]\(|src=\")([^)\s\"]+)")
_log = logging.getLogger("mkdocs.hooks")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages and pictures that are not under docs/."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
    for name in re.findall(r"reference/([\w.]+)\.md", str(config.nav)):
        files.append(
            File.generated(config, f"reference/{name}.md", content=_reference(f"ksim_rl.{name}"))
        )
    texts = [(_origin(file), file.content_string) for file in files.documentation_pages()]
    for origin, text in texts:
        for _, link in _LINK.findall(text):
            if (target := _outside(origin, link)) and not files.get_file_from_path(
                _page_of(target)
            ):
                files.append(_copied(target, config))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links that leave docs/ point to the pages made of what they name."""
    origin = _origin(page.file)

    def moved(match: re.Match[str]) -> str:
        target = _outside(origin, match[2])
        if not target:
            return match[0]
        anchor = match[2].partition("#")[2]
        start = posixpath.dirname(page.file.src_uri) or "."
        return (
            match[1] + posixpath.relpath(_page_of(target), start) + (f"#{anchor}" if anchor else "")
        )

    return _LINK.sub(moved, markdown)


def _origin(file: File) -> str:
    """Return where in the repository a page comes from."""
    return next(
        (source for source, page in PAGES.items() if page == file.src_uri), f"docs/{file.src_uri}"
    )


def _outside(origin: str, link: str) -> str | None:
    """Return the path in the repository that a link of a page has, where the site has it under another one."""
    path = link.partition("#")[0]
    if not path or "://" in path or path.startswith("mailto:"):
        return None
    target = posixpath.normpath(posixpath.join(posixpath.dirname(origin), path))
    if origin.startswith("docs/") and target.startswith("docs/"):
        return None
    if not (ROOT / target).exists():
        _log.warning("%s links to %s, which does not exist", origin, target)
        return None
    return target


def _page_of(target: str) -> str:
    """Return the site's path of a file of the repository."""
    if target in PAGES:
        return PAGES[target]
    if target.startswith("docs/"):
        return target.removeprefix("docs/")
    return f"source/{target}" if target.endswith(".png") else f"source/{target}.md"


def _copied(target: str, config: Any) -> File:
    """Return a file of the repository as a page, and a picture as it is."""
    path = ROOT / target
    if path.suffix == ".png":
        return File.generated(config, _page_of(target), content=path.read_bytes())
    if path.is_dir():
        names = sorted(item.name for item in path.iterdir() if not item.name.startswith(("_", ".")))
        text = "\n".join(f"* `{name}`" for name in names)
    elif path.suffix == ".ipynb":
        cells = json.loads(path.read_text())["cells"]
        sources = [(cell["cell_type"], "".join(cell["source"])) for cell in cells]
        text = "\n\n".join(
            f"```python\n{text}\n```" if kind == "code" else text for kind, text in sources
        )
    else:
        text = f"````{path.suffix.removeprefix('.') or 'text'}\n{path.read_text()}\n````"
    heading = "" if path.suffix == ".ipynb" else f"# `{target}`\n\n"
    return File.generated(config, _page_of(target), content=f"{heading}{text}\n")


def _reference(module: str) -> str:
    """Return a page with what a package gives out, each name under its package."""
    loaded = importlib.import_module(module)
    names = sorted(
        name for name in getattr(loaded, "__all__", vars(loaded)) if _is_ours(loaded, name)
    )
    first = (loaded.__doc__ or "").strip()
    entries = (
        f"::: {getattr(loaded, name).__module__}.{getattr(loaded, name).__qualname__}"
        for name in names
    )
    return "\n\n".join((f"# `{module}`", first, *entries)) + "\n"


def _is_ours(module: Any, name: str) -> bool:
    found = getattr(module, name)
    return (
        not name.startswith("_")
        and getattr(found, "__module__", "").startswith("ksim_rl.")
        and hasattr(found, "__qualname__")
    )
