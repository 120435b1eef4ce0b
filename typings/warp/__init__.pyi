# Inside a Warp kernel Python is only the spelling: Warp has its own types, and checks them when it compiles.
from typing import Any

def __getattr__(name: str) -> Any: ...
