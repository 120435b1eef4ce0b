"""Finds the calls by which a step reads the host: its clocks, random numbers, files and environment.

Their answers would become constants of a recording. Code of libraries may read the host for its own purposes.
"""

import cProfile
import datetime
import inspect
import io
import os
import random
import sys
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ksim_rl.compiled.packages import OURS, is_library, package_of, packages_of
from ksim_rl.compiled.python_states import state_of
from ksim_rl.compiled.python_values import Parts

CLOCKS = frozenset(
    {
        "clock_gettime",
        "clock_gettime_ns",
        "gmtime",
        "localtime",
        "monotonic",
        "monotonic_ns",
        "perf_counter",
        "perf_counter_ns",
        "process_time",
        "process_time_ns",
        "thread_time",
        "time",
        "time_ns",
    }
)
FILES = frozenset({"listdir", "open", "pread", "read", "scandir", "stat", "urandom"})
_DATES = frozenset({"now", "today", "utcnow"})
_ENVIRONMENT = type(os.environ).__getitem__.__code__

CLOCK = "a clock"
RANDOM = "random numbers of the host"
FILE = "a file"
ENVIRONMENT = "an environment variable"


@dataclass(frozen=True, kw_only=True)
class HostCall:
    """A call of `name`, which reads `what` from the host, in the code at `place`, in a `part` of the env (or "")."""

    what: str
    name: str
    place: str
    part: str

    def __str__(self) -> str:
        """Return a text that names the caller, the request and the place."""
        return f"{self.part or 'the step'} asks for {self.what}, by {self.name} at {self.place}"


@contextmanager
def host_calls(parts: Parts) -> Iterator[list[HostCall]]:
    """Collect the calls of this block; `parts` are the objects to which they are ascribed, by name.

    Draws from NumPy's global generator are found by its state, since the profiler does not see calls of its functions.
    """
    tracer = _Tracer(parts)
    # A profiler of the user, such as cProfile, is put back afterwards.
    before = sys.getprofile()
    # A profiler, since it also sees C functions that a module has imported by name.
    sys.setprofile(tracer.notice)
    try:
        yield tracer.found
    finally:
        # Up to Python 3.11 cProfile's own function is written in C: it is put back by its object alone.
        if isinstance(before, cProfile.Profile):
            sys.setprofile(None)
            before.enable()
        else:
            sys.setprofile(before)
        tracer.end()


class _Tracer:
    def __init__(self, parts: Parts) -> None:
        self.found: list[HostCall] = []
        self._names = {id(part): name for name, part in parts.items()}
        self._packages = packages_of(parts.values())
        classes = {cls for part in parts.values() for cls in type(part).__mro__}
        # Code of the parts' methods: cheap to look up at each call, so most calls cost little.
        self._entries = {
            function.__code__
            for cls in classes
            for function in vars(cls).values()
            if inspect.isfunction(function)
        }
        # The parts that are running, innermost last; a call is ascribed to the last of them.
        self._running: list[tuple[types.FrameType, str]] = []
        self._numpy = _numpy_state()

    def notice(self, frame: types.FrameType, event: str, function: Callable) -> None:
        """Look at one event of Python's profiler."""
        if event == "c_call":
            asked = _asked(function)
            if asked is not None:
                self._take(asked, _spelled(function), frame)
        elif event == "call":
            # `os.environ` is Python code, so there is no `c_call` event for it.
            if frame.f_code is _ENVIRONMENT:
                self._take(ENVIRONMENT, "os.environ", frame)
            elif frame.f_code in self._entries:
                self._begin(frame)
        elif event == "return" and self._running and self._running[-1][0] is frame:
            self._end_part()

    def end(self) -> None:
        """Look at numpy once more, for code that is no part."""
        self._look_at_numpy("")

    def _begin(self, frame: types.FrameType) -> None:
        code = frame.f_code
        if code.co_argcount:
            # `self`: several parts may be objects of one class.
            owner = frame.f_locals.get(code.co_varnames[0])
        else:
            owner = None
        name = self._names.get(id(owner))
        if name is not None:
            # Earlier draws were made by the caller.
            self._look_at_numpy(self._part)
            self._running.append((frame, name))

    def _end_part(self) -> None:
        self._look_at_numpy(self._part)
        self._running.pop()

    @property
    def _part(self) -> str:
        if self._running:
            return self._running[-1][1]
        return ""

    def _look_at_numpy(self, part: str) -> None:
        now = _numpy_state()
        if now != self._numpy:
            self._numpy = now
            if self._running:
                place = _place(self._running[-1][0])
            else:
                place = "an unknown place"
            self._add(HostCall(what=RANDOM, name="numpy.random", place=place, part=part))

    def _take(self, what: str, name: str, frame: types.FrameType | None) -> None:
        # Python's own modules ask on behalf of their callers: `random.uniform`, `Path.read_text`.
        # Up to the first frame outside of the standard library.
        while frame is not None and package_of(_module(frame)) in sys.stdlib_module_names:
            frame = frame.f_back
        if frame is None:
            return
        package = package_of(_module(frame))
        # Our own code and libraries may look at a clock to measure themselves.
        is_users = package in self._packages or not is_library(package)
        if is_users and package != OURS:
            self._add(HostCall(what=what, name=name, place=_place(frame), part=self._part))

    def _add(self, call: HostCall) -> None:
        if call not in self.found:
            self.found.append(call)


def _asked(function: Callable) -> str | None:
    """Return the kind of answer that a C function gets from the host, or None."""
    name = getattr(function, "__name__", "")
    owner = getattr(function, "__self__", None)
    # Functions of modules: `time.time`, `os.listdir`, `open`.
    if isinstance(owner, types.ModuleType):
        module = owner.__name__
        if module == "time" and name in CLOCKS:
            return CLOCK
        if module in ("posix", "nt", "io", "_io") and name in FILES:
            if name == "urandom":
                return RANDOM
            return FILE
        if module == "builtins" and name == "input":
            return FILE
        return None
    # Methods of classes: `datetime.now`.
    if isinstance(owner, type):
        if issubclass(owner, datetime.date) and name in _DATES:
            return CLOCK
        return None
    # `type`, because `isinstance` would ask proxies that warn when they are looked at.
    kind = type(owner)
    if issubclass(kind, (random.Random, np.random.Generator, np.random.RandomState)):
        return RANDOM
    if issubclass(kind, io.IOBase) and name.startswith("read"):
        return FILE
    return None


def _spelled(function: Callable) -> str:
    owner = getattr(function, "__self__", None)
    if isinstance(owner, types.ModuleType):
        return f"{owner.__name__}.{function.__name__}"
    if isinstance(owner, type):
        kind = owner
    else:
        kind = type(owner)
    return f"{kind.__name__}.{function.__name__}"


def _numpy_state() -> int:
    return state_of(np.random.mtrand._rand)


def _module(frame: types.FrameType) -> str:
    return frame.f_globals.get("__name__") or ""


def _place(frame: types.FrameType) -> str:
    return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
