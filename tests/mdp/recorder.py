"""A `DebugVisualizer` that notes what it is asked to draw."""

import numpy as np


class Recorder:
    def __init__(self):
        self.drawn = []

    def arrow(self, start, end, *, rgba, width=0.02):
        self.drawn.append(("arrow", np.asarray(start), np.asarray(end)))

    def sphere(self, center, *, radius, rgba):
        self.drawn.append(("sphere", np.asarray(center)))

    def frame(self, origin, rotation, *, scale=0.1):
        self.drawn.append(("frame", np.asarray(origin), np.asarray(rotation)))

    def line(self, start, end, *, rgba, width=2.0):
        self.drawn.append(("line", np.asarray(start), np.asarray(end)))

    def ghost(self, qpos, *, rgba):
        self.drawn.append(("ghost", np.asarray(qpos)))

    def text(self, position, content):
        self.drawn.append(("text", np.asarray(position), content))
