# MuJoCo's bindings are a C extension without type information: everything in them is Any for the type checker.
from typing import Any

def __getattr__(name: str) -> Any: ...
