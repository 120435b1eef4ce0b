"""Stands in for a machine with little memory: Warp's allocator on the CPU refuses what goes beyond."""

from typing import Any

from warp._src import context

from ksim_rl.device import memory
from ksim_rl.trainers import trial


def hold_at_most(size: int, replace: Any = setattr) -> dict[int, int]:
    """Let all arrays of Warp take at most so many bytes together; return what is held, bytes by address.

    `replace(owner, name, value)` is pytest's where it has to be undone.
    """
    allocator: Any = context.CpuDefaultAllocator
    allocate, deallocate = allocator.allocate, allocator.deallocate
    held: dict[int, int] = {}

    def allocate_if_there_is_room(self: Any, asked: int) -> int:
        if sum(held.values()) + asked > size:
            raise RuntimeError(f"Failed to allocate {asked} bytes on device 'cpu'")
        address = allocate(self, asked)
        held[address] = asked
        return address

    def give_back(self: Any, address: int, asked: int) -> None:
        held.pop(address, None)
        deallocate(self, address, asked)

    replace(allocator, "allocate", allocate_if_there_is_room)
    replace(allocator, "deallocate", give_back)
    for module in (memory, trial):
        replace(module, "free_bytes", lambda device: size - sum(held.values()))
    return held
