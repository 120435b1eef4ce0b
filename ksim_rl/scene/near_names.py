"""Refuses misspelled names in terms, and suggests similar ones."""

from typing import TYPE_CHECKING, NoReturn

from ksim_rl.checks import near


class NearNames:
    """Base of objects whose attributes terms read: an unknown name is an AttributeError that lists the near ones."""

    # Hidden from type checkers, to which any attribute would exist.
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> NoReturn:
            """Refuse a name; Python calls this for attributes that it does not find."""
            # A property that failed by an AttributeError of its own: raise that again.
            if hasattr(type(self), name):
                object.__getattribute__(self, name)
            kind = type(self).__name__
            # Python itself asks for such names, and needs no hint.
            if name.startswith("_"):
                raise AttributeError(f"{kind} has no {name!r}")
            names = [other for other in dir(self) if not other.startswith("_")]
            raise AttributeError(
                f"{kind} has no {name!r}: {near(name, names)} (all of them: docs/view.md)"
            )
