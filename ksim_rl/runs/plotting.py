"""The one door to Matplotlib, by its own defaults, whatever lies in the folder in which a user stands."""

import os
from collections.abc import Iterator
from contextlib import chdir, contextmanager

# It reads `matplotlibrc` of the working directory, which may be a stranger's: a pipe, or an order to start TeX.
with chdir(os.sep):
    import matplotlib

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

__all__ = ["Axes", "EngFormatter", "Figure", "FigureCanvasAgg", "plain_style"]


@contextmanager
def plain_style() -> Iterator[None]:
    """Draw by Matplotlib's defaults, and names of runs and terms as they stand: `$` begins no formula."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams["text.parse_math"] = False
        yield
