"""Names the types of plain data, which configs are read from and written as."""

from typing import Any, TypeAlias

# The values that YAML and JSON can hold.
Plain: TypeAlias = dict[str, "Plain"] | list["Plain"] | str | int | float | bool | None
# A config as plain data. Its entries have no type of their own, as readers go on from one to the next.
Tree: TypeAlias = dict[str, Any]
